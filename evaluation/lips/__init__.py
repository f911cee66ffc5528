"""Measure the lips."""
