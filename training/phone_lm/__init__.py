"""Trains phone language models."""
