"""The driver service: renders FAP frames to a window or a video."""
