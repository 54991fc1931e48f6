"""Reuse of remembered contracts in the place where they succeeded."""
