"""Grounding: the scene and retrieved documents as symbols that a planner and the gate can use."""
