"""Structure rules of the repository."""
