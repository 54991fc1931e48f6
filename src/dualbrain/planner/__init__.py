"""Planners: prompt, constrained decoding and language-model backends behind one protocol."""
