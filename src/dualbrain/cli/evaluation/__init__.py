"""Commands: evaluate, report, compare, export."""
