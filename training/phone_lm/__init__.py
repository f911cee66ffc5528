"""Train phone language models."""
