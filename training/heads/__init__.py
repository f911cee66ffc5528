"""Build the heads' assets from MakeHuman data: ``python -m training.heads``."""
