"""One contract or instruction that was submitted to a robot, from its arrival to its outcome."""

from __future__ import annotations

from threading import Condition
from typing import Any, Literal

import msgspec

from dualbrain.contracts.verdict import Accepted, Rejected
from dualbrain.planner.protocol import has_answer
from dualbrain.records import Attempt, Episode, Outcome

State = Literal["planning", "checking", "running", "finished", "rejected", "lost"]
"""planning: the planner works. checking: the gate checks the contract. running: the gate accepted it, and the robot
executes it. finished: it has an outcome. rejected: the gate rejected it, or it was not sent, and nothing moved. lost:
the connection ended, and its outcome is not known."""
ENDED: tuple[State, ...] = ("finished", "rejected", "lost")
"""States that do not change any more."""


class SubmissionReport(msgspec.Struct, frozen=True, kw_only=True):
    """The state of a submission, for its client.

    `id` is that of the contract, or of the instruction. `rejected` is the reason of a rejection, `outcome` the robot's
    own verdict after the end, `senses` the check of that verdict by independent senses ("agrees", "disagrees", "none"),
    and `changes` the perceived changes of the scene in words. `contract` is the contract that the gate accepted.
    `reason` explains a lost submission. `warning`: why the episode of a submission that has an outcome is not saved, or
    not stored in the memory.
    `repeated`: a contract with this id and these actions was submitted before, and this is its report; the robot did
    not move again.
    """

    id: str
    state: State
    rejected: Rejected | None = None
    outcome: Outcome | None = None
    senses: str = ""
    changes: str = ""
    contract: dict[str, Any] | None = None
    episode: str = ""
    reason: str = ""
    warning: str = ""
    repeated: bool = False

    @property
    def accepted(self) -> bool:
        """Whether the gate accepted the contract."""
        return self.contract is not None

    @property
    def succeeded(self) -> bool:
        """Whether the robot reports success."""
        return self.outcome is not None and self.outcome.kind == "succeeded"


class Submission:
    """The state of one submission; every method may be called from any thread."""

    def __init__(self, report: SubmissionReport, digest: str, submitted_at: float) -> None:
        """Begin with `report`; `digest` identifies the content, `submitted_at` is in [s, 1970 UTC]."""
        self.digest, self.submitted_at = digest, submitted_at
        self.interrupted, self.interruption = False, ""
        self._report = report
        self._changed = Condition()

    @property
    def report(self) -> SubmissionReport:
        """The present state."""
        with self._changed:
            return self._report

    @property
    def has_ended(self) -> bool:
        """Whether the state does not change any more."""
        return self.report.state in ENDED

    def interrupt(self, reason: str = "") -> None:
        """Make the robot stop, and drop an answer of the planner that has not arrived; the outcome names `reason`."""
        self.interruption = self.interruption or reason
        self.interrupted = True

    def on_attempt(self, attempt: Attempt) -> None:
        """Follow an attempt: an accepted contract runs, and the reason of a rejection is kept."""
        verdict = attempt.verdict
        if isinstance(verdict, Accepted):
            self._update(state="running", rejected=None, contract=msgspec.to_builtins(verdict.contract))
        elif has_answer(attempt.proposal):
            self._update(rejected=verdict)

    def finish(self, episode: Episode, warning: str = "") -> None:
        """End with the outcome of `episode`; `warning` is why it is not saved."""
        outcome = episode.outcome
        self._update(
            state="rejected" if outcome.kind == "rejected" else "finished",
            outcome=outcome,
            senses=episode.second_opinion,
            changes=episode.changes,
            episode=episode.id,
            warning=warning,
        )

    def reject(self, rejected: Rejected) -> None:
        """End without a motion."""
        self._update(state="rejected", rejected=rejected)

    def lose(self, reason: str) -> None:
        """End without an outcome."""
        self._update(state="lost", reason=reason)

    def wait_for_verdict(self, timeout: float) -> SubmissionReport:
        """The report as soon as the gate has given its verdict, or after `timeout` [s]."""
        return self._wait(lambda report: report.state not in ("planning", "checking"), timeout)

    def wait_for_end(self, timeout: float | None) -> SubmissionReport:
        """The report as soon as the submission has ended, or after `timeout` [s] (None: without a limit)."""
        return self._wait(lambda report: report.state in ENDED, timeout)

    def _wait(self, condition: Any, timeout: float | None) -> SubmissionReport:
        with self._changed:
            self._changed.wait_for(lambda: condition(self._report), timeout)
            return self._report

    def _update(self, **changes: Any) -> None:
        with self._changed:
            if self._report.state not in ENDED:
                self._report = msgspec.structs.replace(self._report, **changes)
            self._changed.notify_all()
