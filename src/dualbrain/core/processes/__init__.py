"""Processes: end with the parent, real-time priority, pacing of loops in real time."""
