"""The ledger in PostgreSQL, for several robots that share their memories."""
