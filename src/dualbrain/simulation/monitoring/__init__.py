"""Independent monitor of contacts, limits and object handling on simulator ground truth."""
