"""Reads the spoken text of a recording."""
