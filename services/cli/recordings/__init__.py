"""The commands for recordings: files in, files out."""
