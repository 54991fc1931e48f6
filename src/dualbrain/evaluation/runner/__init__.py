"""Resumable runner: work units, worker pool, provenance, preflight checks."""
