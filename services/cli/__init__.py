"""The command line: every command of ``kouxing``."""
