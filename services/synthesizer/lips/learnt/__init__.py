"""Lips as the sound itself tells them, with the closures and the tongue of recognised phones."""
