"""Mouth profiles: learns how one speaker's lips differ from the predicted average lips."""
