"""Training of models. Services and evaluation never import it."""

SYNTHETIC_WEIGHT = 0.3  # relative to natural speech; chosen on development data
