"""Early stopping: training ends when the planner no longer improves on held-out data."""

from __future__ import annotations

import msgspec

MAX_LOSS_RATIO = 0.99
"""At equal compliance, the held-out loss must fall below this part of the best loss to count as an improvement."""


class HeldOutResult(msgspec.Struct, frozen=True):
    """Result on held-out questions at `step`: mean cross-entropy [nats/token] and share of compliant answers.

    The share is None if no question was asked.
    """

    step: int
    compliance: float | None
    loss: float

    def is_better_than(self, other: HeldOutResult | None) -> bool:
        """Whether it is more compliant than `other`, or as compliant with a loss at least 1 % lower.

        Compliance comes first because a planner learns the form of contracts before their values.
        """
        if other is None:
            return True
        if self.compliance is not None and other.compliance is not None and self.compliance != other.compliance:
            return self.compliance > other.compliance
        return self.loss < MAX_LOSS_RATIO * other.loss


class EarlyStopping(msgspec.Struct, frozen=True):
    """The best result so far, and the number of evaluations since then."""

    best: HeldOutResult | None = None
    waited: int = 0

    def updated(self, result: HeldOutResult) -> EarlyStopping:
        """The state after the result `result`."""
        return (
            EarlyStopping(result, 0) if result.is_better_than(self.best) else EarlyStopping(self.best, self.waited + 1)
        )
