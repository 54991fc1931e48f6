"""Instructions in natural language with the outcome that counts as right, written before they were run."""
