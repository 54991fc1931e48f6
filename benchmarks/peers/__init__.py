"""Comparison of the safety filter with other libraries: each filter in a separate process, on the same states."""
