"""Trains the Gaussian mixture models."""
