"""Training of models; never imported by a service, nor by the evaluation."""

SYNTHETIC_WEIGHT = 0.3  # relative to real speech; chosen on development data
