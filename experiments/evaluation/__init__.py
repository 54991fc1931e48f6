"""Experiments on the methods of the evaluation."""
