"""Trains lips from sound."""
