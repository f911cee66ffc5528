"""Languages as values: phone inventories, their lexicons and visemes, and timed phones."""
