"""Builds the heads from MakeHuman data: ``python -m kouxing.training.heads``."""
