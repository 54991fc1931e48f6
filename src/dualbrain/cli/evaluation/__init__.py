"""Commands: evaluate, report, compare."""
