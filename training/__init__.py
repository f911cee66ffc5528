"""Training of models; never imported by a service."""

SYNTHETIC_WEIGHT = 0.3  # of synthetic against real speech; chosen on development data
