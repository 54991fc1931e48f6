"""Which seeds are for what: disjoint ranges, in this one place.

Proofs and demonstrations use those below 10 000, lessons those from 50 000 (`adaptation/lessons/split.py`).
"""

from __future__ import annotations

PILOT = range(10_000, 20_000)
"""ε is set on these, before any test."""
START = range(20_000, 30_000)
"""The ledger from which all arms with memory start."""
TEST = range(40_000, 50_000)
"""What is reported."""
