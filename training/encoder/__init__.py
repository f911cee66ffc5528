"""Training of the audio encoder: one network for lips, voice, pitch and effort."""
