"""Logs and metrics of services."""
