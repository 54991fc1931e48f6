"""Exploration: named alternatives of one task at one place, executed in the kinematic twin."""
