"""Reads users' files and tables, and writes output files."""
