"""Commands: robot."""
