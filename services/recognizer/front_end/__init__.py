"""Front end: resampling, features, pitch, voice activity detection and VTLN."""
