"""Builds the distributions of a release, and checks them in clean environments."""
