"""Acoustic models: state scores from feature frames."""
