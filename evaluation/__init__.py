"""Measurements: tables and JSON."""
