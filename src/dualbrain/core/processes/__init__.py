"""Processes: end with the parent, real-time priority, pacing in real time, an event loop that keeps time limits."""
