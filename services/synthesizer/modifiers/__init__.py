"""Modifiers of the face after the lip model: amplitude, expressions and motion."""
