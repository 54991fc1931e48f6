"""Clauses of an instruction that contracts cannot express."""
