"""Starts services and supervises their processes."""
