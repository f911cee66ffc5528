"""Other real-time lip sync, run on the clips of a folder."""
