"""The spinal cord as a process of its own: it owns robot, skills, filter, supervisor and the control tick.

What is above it (the cortex: planner, memory, people's screens) talks to it over a Unix socket and is never believed.
"""
