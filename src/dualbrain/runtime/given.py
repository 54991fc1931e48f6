"""A contract from a person instead of a planner: it takes the same way through the gate."""

from __future__ import annotations

from dualbrain.planner.protocol import STOP
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal


class GivenContract:
    """Proposes the bytes it was given, whatever is asked."""

    def __init__(self, source: str, data: bytes) -> None:
        """`source` is what the record names as the author."""
        self.name = source
        self._text = data.decode("utf-8", "surrogateescape")

    def propose(self, request: PlanRequest) -> Proposal:
        """The given text."""
        del request
        return Proposal(self._text, STOP, self.name, "nobody", {"total": 0.0})

    def close(self) -> None:
        """Nothing to release."""
