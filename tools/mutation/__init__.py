"""Mutation test of the safety kernel: small deliberate faults, and whether the tests detect them."""
