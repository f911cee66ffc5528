"""Lips of one opening R over time, drawn as Ferguson curves: Zhang et al. 2021."""
