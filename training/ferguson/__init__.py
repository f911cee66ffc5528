"""Learns the table of the ferguson lips, and how far each FAP travels."""
