"""Crash-safe storage: atomic writes, locks, JSONL logs, SQLite transactions, resumable work in steps."""
