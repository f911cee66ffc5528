"""Training of the block model: Whisper's encoder in blocks with a cached past, gently tuned."""
