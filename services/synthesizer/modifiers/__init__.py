"""What changes a face after its lip model: amplitude, expression, idle motion."""
