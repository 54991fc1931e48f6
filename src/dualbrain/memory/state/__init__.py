"""State derived from the ledger: episodes, weights, history, snapshots."""
