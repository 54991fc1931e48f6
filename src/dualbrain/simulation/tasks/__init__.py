"""Tasks: instructions, goals, success criteria, hashes of the reported scenes."""
