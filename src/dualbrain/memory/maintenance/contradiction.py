"""When too few agree with a memory for it to stand: one rule for the audit and for anomalous replay."""

from __future__ import annotations

from math import comb

EXPECTED_AGREEMENT = 0.8
"""At least this share of those who judge a true memory is expected to agree with it: outcomes are partly chance."""
SIGNIFICANCE_LEVEL = 0.05
"""A memory is contradicted if so few agree that a true one would show that with a chance below this."""


def agreement_p_value(agreeing: int, compared: int) -> float:
    """P(X ≤ agreeing) for X ~ Binomial(asked, 0.8): how likely so little agreement is for a true memory."""
    return sum(
        comb(compared, k) * EXPECTED_AGREEMENT**k * (1.0 - EXPECTED_AGREEMENT) ** (compared - k)
        for k in range(agreeing + 1)
    )


def is_contradicted(agreeing: int, compared: int) -> bool:
    """Whether `agreeing` of `asked` are too few. One against one is no evidence, two against none is."""
    return agreement_p_value(agreeing, compared) < SIGNIFICANCE_LEVEL
