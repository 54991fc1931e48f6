"""The ledger in one SQLite file: its tables, its other files, and the check of foreign objects."""
