"""What changes a face after its lip model: amplitude, idle motion."""
