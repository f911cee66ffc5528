"""The recognizer service: turns audio chunks into phones with times."""
