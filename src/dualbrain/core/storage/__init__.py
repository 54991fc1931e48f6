"""Files that survive a crash: atomic writes, locks, JSONL logs, SQLite transactions, resumable work folders."""
