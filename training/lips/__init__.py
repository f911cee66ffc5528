"""Train lips from sound."""
