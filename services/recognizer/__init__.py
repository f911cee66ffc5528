"""Recognizer: audio chunks in, phones with times out."""
