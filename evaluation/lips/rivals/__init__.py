"""Other real-time lip sync, and loudness, beside kouxing's lip models at the same delays."""
