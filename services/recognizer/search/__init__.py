"""The search for the best phones: decoder, phone language model, output rule."""
