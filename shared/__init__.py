"""Shared code: messages, sockets, the service loop, configuration, phones, FAPs and audio files."""
