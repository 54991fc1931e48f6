"""Kinematic twin: a fast simulation without contact physics, for exploration only."""
