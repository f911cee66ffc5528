"""Mouth profiles: learn how one speaker's lips differ from the lip model's average speaker."""
