"""Listening tests: people judge videos of talking heads, and what their scores say."""
