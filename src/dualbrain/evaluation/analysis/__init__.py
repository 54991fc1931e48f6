"""Metrics, statistics, failure taxonomy and verdicts on the hypotheses."""
