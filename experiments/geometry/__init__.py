"""Experiments on the validation of geometric input."""
