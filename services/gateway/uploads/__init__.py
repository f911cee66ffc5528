"""Receives and decodes uploaded recordings."""
