"""The big proofs: one file a proof, each a list of units whose results are rows of a journal."""
