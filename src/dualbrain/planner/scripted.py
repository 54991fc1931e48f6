"""Planners with given answers: a script for tests, from which no result may be reported, fixed and recorded answers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from dualbrain.planner import protocol
from dualbrain.planner.protocol import STOP
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal


class ScriptedPlanner:
    """Answers with `texts` in order, then repeats the last one; stores the received requests in `requests`."""

    def __init__(self, texts: Sequence[str], *, finish_reason: str = protocol.STOP) -> None:
        self._texts, self._finish_reason = tuple(texts), finish_reason
        self.requests: list[PlanRequest] = []

    @property
    def name(self) -> str:
        """The name "scripted", which shows that there is no model."""
        return "scripted"

    def propose(self, request: PlanRequest) -> Proposal:
        """The next text of the script."""
        self.requests.append(request)
        text = self._texts[min(len(self.requests), len(self._texts)) - 1] if self._texts else ""
        return Proposal(
            text=text,
            finish_reason=self._finish_reason,
            planner=self.name,
            timings={"total": 0.0},
        )

    def close(self) -> None:
        """Do nothing: no resource is open."""


class FixedContractPlanner:
    """Proposes the same given bytes for every request."""

    def __init__(self, source: str, data: bytes) -> None:
        """Create a planner that proposes `data`; `source` is recorded as the author."""
        self.name = source
        self._text = data.decode("utf-8", "surrogateescape")

    def propose(self, request: PlanRequest) -> Proposal:
        """A proposal with the given text."""
        del request
        return Proposal(text=self._text, finish_reason=STOP, planner=self.name, timings={"total": 0.0})

    def close(self) -> None:
        """Do nothing: no resource is open."""


NO_ANSWER_LEFT = f"{protocol.ERROR}: more answers were requested than are recorded"


class RecordedAnswers:
    """Repeats recorded answers, attempt by attempt, so that a run has the same contracts again."""

    def __init__(self, answers: Iterable[Sequence[str]], *, name: str = "recorded answers") -> None:
        """`answers` are pairs (text, finish reason); `name` is recorded as the author."""
        self._answers = iter(answers)
        self.name = name

    def propose(self, request: PlanRequest) -> Proposal:
        """The next answer; an error as the finish reason after the last one."""
        del request
        text, finish = next(self._answers, ("", NO_ANSWER_LEFT))
        return Proposal(text=text, finish_reason=finish, planner=self.name, timings={"total": 0.0})

    def close(self) -> None:
        """Do nothing: no resource is open."""
