"""Evaluation protocol (paper 7): methods, runner, metrics, statistics, hypotheses, report."""
