"""Serving an adapted planner, and its measurement: canary, shadow comparison, perplexity."""
