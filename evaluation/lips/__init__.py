"""Measures the lips."""
