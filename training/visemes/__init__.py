"""Fit the dynamic visemes to tracked lips."""
