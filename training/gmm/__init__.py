"""Train the Gaussian mixture models."""
