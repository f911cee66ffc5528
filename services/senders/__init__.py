"""Sends the face to avatar programs by VMC, Live Link Face, OSC or VTube Studio's API."""
