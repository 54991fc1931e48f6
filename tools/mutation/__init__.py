"""Mutation check: small mistakes made on purpose, and whether the tests of the laws notice."""
