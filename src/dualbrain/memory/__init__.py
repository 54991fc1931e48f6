"""Episodic memory (paper 5): event ledger, joint embedding, retrieval R and learned weights w."""
