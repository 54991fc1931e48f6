"""The goal of an instruction, read from its words by a deterministic parser that shares nothing with a planner."""
