"""Training of models; never imported by a service."""
