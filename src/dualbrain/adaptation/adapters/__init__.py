"""Adapter registry: cards, compatibility, comparison, promotion."""
