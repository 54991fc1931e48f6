"""Training of the packaged classifier of clauses."""
