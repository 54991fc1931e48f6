"""Append-only, hash-chained event ledger in SQLite, the only source from which memory is derived."""
