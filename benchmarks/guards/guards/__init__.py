"""The compared guards, one file each."""
