"""Experiments with several robots, and with robosuite."""
