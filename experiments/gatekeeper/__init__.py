"""Experiments on the gatekeeper process: faults, lost commanders, fuzzing, tick timing."""
