"""The gatekeeper: a separate process that owns robot, skills, filter, supervisor and control tick.

Planner, memory and user interfaces connect to it over a Unix socket; nothing that they send is trusted.
"""
