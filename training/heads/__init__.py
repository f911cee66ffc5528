"""Builds the heads from MakeHuman data: ``kouxing train heads``."""
