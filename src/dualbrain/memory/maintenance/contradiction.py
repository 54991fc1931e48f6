"""When too few agree with a memory for it to stand: one rule for the audit and for anomalous replay."""

from __future__ import annotations

from math import comb

RIGHT = 0.8
"""At least this share of those who judge a true memory is expected to agree with it: outcomes are partly chance."""
ALPHA = 0.05
"""A memory is contradicted if so few agree that a true one would show that with a chance below this."""


def chance(agreeing: int, asked: int) -> float:
    """P(X ≤ agreeing) for X ~ Binomial(asked, 0.8): how likely so little agreement is for a true memory."""
    return sum(comb(asked, k) * RIGHT**k * (1.0 - RIGHT) ** (asked - k) for k in range(agreeing + 1))


def contradicted(agreeing: int, asked: int) -> bool:
    """Whether `agreeing` of `asked` are too few. One against one is no evidence, two against none is."""
    return chance(agreeing, asked) < ALPHA
