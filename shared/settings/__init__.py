"""The settings of a process: configuration, keys and endpoints."""
