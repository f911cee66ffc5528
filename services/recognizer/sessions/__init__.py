"""The sessions of the service: their audio and results, and decoding in batches."""
