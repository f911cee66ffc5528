"""Reads and converts audio: files, pipes, devices and PCM."""
