"""Recognizes, transcribes and aligns recordings."""
