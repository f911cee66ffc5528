"""Recognizes live audio: from samples to phones, lip positions and speech events."""
