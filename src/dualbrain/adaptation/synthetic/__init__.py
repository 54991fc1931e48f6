"""Synthetic instruction data: instructions from templates, answered by random valid contracts."""
