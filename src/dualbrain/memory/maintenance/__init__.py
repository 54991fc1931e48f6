"""Audit, edits, compaction, export and verification of a ledger."""
