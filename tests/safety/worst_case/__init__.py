"""Tests that unknown and unusable input counts as the worst case."""
