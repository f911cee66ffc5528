"""Learns the table of the ferguson lip model, and how far each FAP travels."""
