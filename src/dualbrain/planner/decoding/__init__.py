"""Grammars for constrained decoding, generated from the decoding schema of a contract."""
