"""Test whether too few outcomes agree with a memory; used by the audit and by the replay in simulation."""

from __future__ import annotations

from math import comb

EXPECTED_AGREEMENT = 0.8
"""Expected share of outcomes that agree with a correct memory; below 1, because outcomes are partly random."""
SIGNIFICANCE_LEVEL = 0.05
"""A memory is contradicted if a correct one would have so little agreement with a probability below this level."""


def agreement_p_value(agreeing: int, compared: int) -> float:
    """P(X ≤ agreeing) for X ~ Binomial(compared, 0.8): the probability of so little agreement with a correct memory."""
    return sum(
        comb(compared, k) * EXPECTED_AGREEMENT**k * (1.0 - EXPECTED_AGREEMENT) ** (compared - k)
        for k in range(agreeing + 1)
    )


def is_contradicted(agreeing: int, compared: int) -> bool:
    """Whether `agreeing` of `compared` outcomes are too few: 1 of 2 is no contradiction, 0 of 2 is one."""
    return agreement_p_value(agreeing, compared) < SIGNIFICANCE_LEVEL
