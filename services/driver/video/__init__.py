"""Writes videos and pictures of a head."""
