"""Acoustic models: score HMM states from feature frames."""
