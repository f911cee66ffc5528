"""Gateway: the head in a browser, with sound and microphone."""
