"""Retrieval by R = λ_s s + (1 − λ_s) w̄, and diversity of the retrieved memories."""
