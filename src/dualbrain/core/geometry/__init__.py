"""Rotations, shapes, and exact distances between them."""
