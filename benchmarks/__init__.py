"""Benchmarks: durations and exact work, beside named peers."""
