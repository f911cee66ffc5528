"""Helpers of all commands: terminal output, and the connection to control."""
