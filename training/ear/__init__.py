"""Training of the small ear: one network for lips, voice, pitch and effort."""
