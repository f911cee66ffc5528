"""Videos and pictures of a head."""
