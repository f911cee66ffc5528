"""Build the heads' assets from MakeHuman data: ``python -m kouxing.training.heads``."""
