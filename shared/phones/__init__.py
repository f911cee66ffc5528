"""Languages (phone inventories, lexicons and visemes) and timed phones."""
