"""The filter of a trial, on the host or on an emulated board, and what the supervisor of the board did."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import TYPE_CHECKING, cast

import msgspec

from dualbrain.evaluation.fault_injection.faults import FaultInjector
from dualbrain.evaluation.fault_injection.faulty_link import FaultyLink
from dualbrain.robots.model import RobotModel
from dualbrain.runtime.assembly import open_filter
from dualbrain.safety.cbf.filter import FilterResult, SafetyFilter
from dualbrain.safety.supervisor.actions import SafetyAction

if TYPE_CHECKING:
    from dualbrain.safety.target.target_filter import TargetFilter


class TargetReport(msgspec.Struct, frozen=True, kw_only=True):
    """The part of the target in a trial.

    `answers`: decisions after the fault; none if the host ended with it. `reached`: the strongest of them. `drive_off`:
    whether one of them switched the drive off. `steps` were computed on target and host, `differences` of them with
    different bits. `lost`: why it was lost.
    """

    board: str
    answers: int
    reached: str
    drive_off: bool
    steps: int
    differences: int
    lost: str


class TargetObserver:
    """Observes the decisions of a target in every tick after the fault; without a target it has no report."""

    def __init__(self, safety: SafetyFilter, target: TargetFilter | None, injector: FaultInjector) -> None:
        """Observe `target`, which is `safety` if the trial runs on one."""
        self.safety = safety
        self._target, self._injector = target, injector
        self._answers, self._reached, self._drive_off = 0, SafetyAction.NONE, False

    def __call__(self, result: FilterResult, action: SafetyAction, *, in_contract: bool) -> None:
        """Record the target's decision of this tick."""
        del result, action, in_contract
        reply = self._target.target.reply if self._target is not None else None
        if reply is not None and self._injector.triggered_at is not None:
            self._answers += 1
            self._reached = max(self._reached, SafetyAction(reply.action))
            self._drive_off |= not reply.drive_enabled

    def report(self) -> TargetReport | None:
        """The part of the target in the trial; None without a target."""
        if self._target is None:
            return None
        kernel = self._target.target
        return TargetReport(
            board=kernel.board,
            answers=self._answers,
            reached=self._reached.name,
            drive_off=self._drive_off,
            steps=kernel.steps,
            differences=kernel.differences,
            lost=kernel.lost,
        )


@contextmanager
def open_observed_filter(robot_model: RobotModel, board: str, injector: FaultInjector) -> Generator[TargetObserver]:
    """The filter of a trial, on the emulated `board` behind a link that may fail, or in this process if it is empty.

    Raises as `open_filter`.
    """
    with open_filter(robot_model, board) as safety:
        target = cast("TargetFilter", safety) if board else None
        if target is not None:
            target.target.session.link = FaultyLink(target.target.session.link, injector)
        yield TargetObserver(safety, target, injector)
