"""The messages that cross a socket, by domain, and their bytes."""
