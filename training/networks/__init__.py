"""Code that the network trainings share: Whisper's encoder, labels, augmentation, export."""
