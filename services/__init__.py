"""The services of kouxing; each runs on its own as ``python -m kouxing.services.<name>``."""
