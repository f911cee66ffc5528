"""Train the neural models."""
