"""Fits the dynamic visemes to tracked lips."""
