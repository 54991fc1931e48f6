"""Grammars for constrained decoding, generated from the contract schema."""
