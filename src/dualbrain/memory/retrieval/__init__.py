"""Retrieval by R = λ s + (1 − λ) w, and diversity of the retrieved items."""
