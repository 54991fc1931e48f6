"""Early stopping: is the planner still getting better on what it is not trained on?"""

from __future__ import annotations

import msgspec

MAX_LOSS_RATIO = 0.99
"""At equal compliance the held-out loss must fall below this part of the best to count as progress."""


class HeldOutResult(msgspec.Struct, frozen=True):
    """What held-out questions gave at `step`: mean cross-entropy [nats/token], share of compliant free answers.

    The share is None where nothing was asked.
    """

    step: int
    compliance: float | None
    loss: float

    def is_better_than(self, other: HeldOutResult | None) -> bool:
        """More compliant, or as compliant at a loss that is lower by 1 %: form comes first, values follow later."""
        if other is None:
            return True
        if self.compliance is not None and other.compliance is not None and self.compliance != other.compliance:
            return self.compliance > other.compliance
        return self.loss < MAX_LOSS_RATIO * other.loss


class EarlyStopping(msgspec.Struct, frozen=True):
    """The best so far, and for how many rounds nothing was better."""

    best: HeldOutResult | None = None
    waited: int = 0

    def updated(self, found: HeldOutResult) -> EarlyStopping:
        """What `found` changes."""
        return EarlyStopping(found, 0) if found.is_better_than(self.best) else EarlyStopping(self.best, self.waited + 1)
