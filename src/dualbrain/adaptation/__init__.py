"""Offline fine-tuning of the planner (paper 6): curation, training, adapter registry, serving."""
