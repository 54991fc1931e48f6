"""How an adapted planner answers: untouched base and adapter in the runtime that serves, and what watches them."""
