"""Predicts lip positions from the features of the audio encoder."""
