"""Tasks: instructions, goals, success criteria, frozen scene hashes."""
