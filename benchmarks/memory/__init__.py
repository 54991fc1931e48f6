"""Benchmarks of the episodic memory."""
