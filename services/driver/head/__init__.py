"""Heads: loading, deforming, importing, exporting."""
