"""Modifiers of the face after the lip model: amplitude, expressiveness, expression, idle motion."""
