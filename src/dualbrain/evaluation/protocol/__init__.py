"""Suites, methods, cases and baselines of the protocol."""
