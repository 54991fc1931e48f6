"""Lessons in the contract language: instructions from templates, answered by contracts with random valid parameters."""
