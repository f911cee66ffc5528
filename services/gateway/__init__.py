"""The gateway service: shows the head in a browser, with sound and microphone."""
