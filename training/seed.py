"""The seed of all recipes: the same data give the same model."""

SEED = 0
