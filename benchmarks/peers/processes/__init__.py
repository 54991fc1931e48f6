"""Processes of the compared filters: the worker and the parent that sends requests to it."""
