"""Experiments on planning and contracts."""
