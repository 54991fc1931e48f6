"""Experiments on the episode memory."""
