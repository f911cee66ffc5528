"""The services of kouxing; each runs on its own as ``python -m services.<name>``."""
