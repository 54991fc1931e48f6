"""What people look at: the live view and the report of a run."""
