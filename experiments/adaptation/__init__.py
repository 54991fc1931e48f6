"""Experiments on adaptation of the planner."""
