"""A robot as an agent sees it: scene, checked contracts, outcomes, and tools for any agent framework."""
