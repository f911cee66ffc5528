"""Lip models: mouth FAPs from what the recognizer tells."""
