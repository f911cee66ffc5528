"""Measures the running system: latency, cost, drawing."""
