"""Measures the recognizer."""
