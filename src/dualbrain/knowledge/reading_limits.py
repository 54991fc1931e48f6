"""How much is read of one document."""

LARGEST_FILE = 16 * 1024 * 1024
"""Bytes of a file."""
LARGEST_READING = 2_000_000
"""Characters of a reading: a thousand pages."""
SHORTEST = 20
"""A document with fewer visible characters says nothing."""
