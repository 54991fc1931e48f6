"""Audit, edits, compaction, export, projection and verification of a memory."""
