"""ZeroMQ sockets, reliable streams, and limits for peers."""
