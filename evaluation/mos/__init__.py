"""A listening test: people judge videos of talking heads in a browser."""
