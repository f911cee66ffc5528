"""The services of kouxing; each runs separately as ``python -m kouxing.services.<name>``."""
