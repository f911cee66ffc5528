"""Training of models. Services and evaluation never import it."""
