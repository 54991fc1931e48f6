"""Commands `dualbrain memory ...`."""
