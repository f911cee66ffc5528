"""Streams audio from browsers and the sample sentence into sessions."""
