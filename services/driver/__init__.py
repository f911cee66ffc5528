"""Driver: FAP frames in, a rendered head out (window, video)."""
