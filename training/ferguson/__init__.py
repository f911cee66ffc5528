"""Trains the table of the ferguson lip model, and the travel of each FAP."""
