"""Units of an evaluation on a Ray cluster."""
