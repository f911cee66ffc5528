"""Draws a head with OpenGL, and captions below it."""
