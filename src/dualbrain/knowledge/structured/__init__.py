"""Structured documents: maps and task templates."""
