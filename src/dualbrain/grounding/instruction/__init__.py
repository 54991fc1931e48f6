"""Reading of instructions without a planner: goals, clauses, stop words, languages."""
