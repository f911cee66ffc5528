"""Training of the window model: Whisper's encoder as it is, with a readout learnt on windows."""
