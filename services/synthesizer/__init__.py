"""Synthesizer: phones in, FAP frames out."""
