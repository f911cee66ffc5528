"""Measure the recognizer."""
