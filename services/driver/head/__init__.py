"""Heads: loading, deformation, import and export."""
