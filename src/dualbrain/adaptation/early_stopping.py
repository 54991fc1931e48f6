"""Early stopping: is the planner still getting better on what it is not trained on?"""

from __future__ import annotations

import msgspec

BETTER = 0.99
"""At equal compliance the held-out loss must fall below this part of the best to count as progress."""


class HeldOut(msgspec.Struct, frozen=True):
    """What held-out questions gave at `step`: mean cross-entropy [nats/token], share of compliant free answers.

    The share is None where nothing was asked.
    """

    step: int
    compliance: float | None
    loss: float

    def beats(self, other: HeldOut | None) -> bool:
        """More compliant, or as compliant at a loss that is lower by 1 %: form comes first, values follow later."""
        if other is None:
            return True
        if self.compliance is not None and other.compliance is not None and self.compliance != other.compliance:
            return self.compliance > other.compliance
        return self.loss < BETTER * other.loss


class Patience(msgspec.Struct, frozen=True):
    """The best so far, and for how many rounds nothing was better."""

    best: HeldOut | None = None
    waited: int = 0

    def after(self, found: HeldOut) -> Patience:
        """What `found` changes."""
        return Patience(found, 0) if found.beats(self.best) else Patience(self.best, self.waited + 1)
