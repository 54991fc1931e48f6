"""Experiments on the gatekeeper process: faults, lost commanders, tick timing."""
