"""WebRTC clients: their audio, and the frames of their sessions."""
