"""Lip models: mouth FAPs from sound events."""
