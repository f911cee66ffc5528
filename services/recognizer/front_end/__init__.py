"""From sound to feature frames: resampling, features, voice activity, VTLN."""
