"""Experiments: slow, resumable tests of claims, run by `python -m experiments`."""
