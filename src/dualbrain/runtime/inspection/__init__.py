"""Inspection without a new run: plans without motion, replay of memories, use of retrieved memories."""
