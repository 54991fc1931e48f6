"""Tables and texts of an evaluation report."""
