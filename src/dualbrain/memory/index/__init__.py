"""Rebuildable search index over the embeddings of the ledger."""
