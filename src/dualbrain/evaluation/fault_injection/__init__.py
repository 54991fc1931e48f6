"""Fault injection: faults, trials and clients that misbehave."""
