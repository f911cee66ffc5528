"""The driver service: FAP frames in, a rendered head out (window, video)."""
