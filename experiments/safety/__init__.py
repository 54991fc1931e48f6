"""Experiments on the safety filter."""
