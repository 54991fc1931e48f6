"""Seeded scene generators, one family of scenes each."""
