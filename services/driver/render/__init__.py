"""Drawing a head."""
