"""Lip models: compute mouth FAPs from sound events."""
