"""Append-only, hash-chained event ledger in SQLite: the source of truth of the memory."""
