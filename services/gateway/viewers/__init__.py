"""Shows sessions to browsers."""
