"""Measure the running system: latency, cost, drawing."""
