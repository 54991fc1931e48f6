"""The gatekeeper: a process of its own that owns robot, skills, filter, supervisor and the control tick.

Planner, memory and user interfaces talk to it over a Unix socket; nothing they send is trusted.
"""
