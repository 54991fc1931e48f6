"""The approver: every action becomes the closest safe one, with a sentence that states which limit changed it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal

import numpy as np
from inspect_robots.approver import DeltaLimitApprover
from inspect_robots.errors import SafetyAbort
from inspect_robots.types import Action, Observation

from dualbrain import ConfigurationError, FilterStatus, Obstacle, PolicyGuard
from dualbrain.safety.integration.policy_guard.guard import GuardReport
from inspect_robots_dualbrain.joint_state import JointStateReader

RECORD = "dualbrain"
"""Key of the review in `Action.meta`, `StepResult.info` and `Observation.extra`."""
ACTION_BOUND = "action bound"
CLAMPS = {
    "clamped": "the bounds of the action space clipped the action",
    "delta_clamped": "the step limit of inspect-robots shortened the action",
}
"""Flags of the approvers of inspect-robots that changed an action before this one."""
REST_SPEED = 1e-3
"""Joint speed [rad/s] below which the arm is at rest."""
Scene = Callable[[Observation, float], Sequence[Obstacle]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Review:
    """The answer to one action.

    `verdict`: approved (the action is the policy's), modified, or rejected (the arm comes to rest). `limit`: the kind
    of limit with the largest effect, a value of `LimitKind`, or "action bound" if only inspect-robots itself clipped
    the action. `explanation`: one sentence with the joint, or the link and the object.
    """

    verdict: Literal["approved", "modified", "rejected"]
    limit: str
    explanation: str

    def as_dict(self) -> dict[str, str]:
        """The review as plain strings."""
        return asdict(self)


class DualbrainApprover:
    """Approver of inspect-robots: `review` returns the action itself, the closest safe one, or raises `SafetyAbort`.

    Unusable actions and joint states bring the arm to rest. If it has rested for one action and the next one is
    rejected too, or if no action can stop the arm, the evaluation is halted with cause and remedy. State: the `last`
    review, the last approved action until it is executed, and whether the arm rested during the last rejected action.
    """

    def __init__(self, guard: PolicyGuard, states: JointStateReader, scene: Scene | None = None) -> None:
        """Review with `guard`, at the joint state of `states`; `scene(observation, now)` gives moving obstacles."""
        self.guard, self._states, self._scene = guard, states, scene
        self.last: Review | None = None
        self._approved: Action | None = None
        self._has_held = False

    def begin(self, observation: Observation) -> None:
        """Begin an episode with the `observation` of the reset."""
        self.guard.reset()
        self._states.begin(observation)
        self.last, self._approved, self._has_held = None, None, False

    def update(self, observation: Observation) -> None:
        """Take the `observation` after a step."""
        self._states.update(observation)

    def review(self, action: Action, store: dict[str, Any]) -> Action:
        """The action to execute: `action` itself if it is safe.

        Raises:
            SafetyAbort: no action can stop the arm, or it rested during the last rejected action and this one is
                rejected too.
        """
        self._approved = None
        was_at_rest = not float(np.abs(self.guard.control).max()) > REST_SPEED  # NaN before the first action
        try:
            safe = self._guarded(action)
        except ConfigurationError as error:
            self.last = Review(verdict="rejected", limit="input", explanation=str(error))
            raise SafetyAbort(str(error)) from error
        report = self.guard.report
        self.last = _review(report, is_changed=safe is not action.data, action=action)
        if report.problem and self._has_held:
            raise SafetyAbort(report.problem)
        self._has_held = bool(report.problem) and was_at_rest
        if safe is not action.data:
            meta = {name: value for name, value in action.meta.items() if name not in CLAMPS}
            action = replace(action, data=safe, meta={**meta, RECORD: self.last.as_dict()})
            DeltaLimitApprover.rewind_reference(store, np.asarray(safe, dtype=np.float64))
        self._approved = action
        return action

    def claim(self, action: Action) -> None:
        """Take `action` for its execution.

        Raises:
            SafetyAbort: it is not the action that `review` returned last, or it was executed before.
        """
        approved, self._approved = self._approved, None
        if action is not approved:
            raise SafetyAbort(
                "The guarded embodiment executes only the action that its approver returned last. Remedy: pass "
                "`approver=embodiment.approver`, as the last one of a chain; or use the inner embodiment unguarded"
            )

    def _guarded(self, action: Action) -> Any:
        state = self._states.take()
        if state.problem:
            return self.guard.stop(state.problem, state.q, state.v, state.now)
        if self._scene is not None and self._states.observation is not None:
            self.guard.safety.observe(self._scene(self._states.observation, state.now), state.now)
        return self.guard(action.data, state.q, state.v, state.now)


def _review(report: GuardReport, *, is_changed: bool, action: Action) -> Review:
    """The review of `action` from the `report` of the guard."""
    clamps = [text for flag, text in CLAMPS.items() if action.meta.get(flag)]
    if not is_changed:
        limit = ACTION_BOUND if clamps else str(report.limit)
        return Review(verdict="approved", limit=limit, explanation="; ".join((*clamps, report.explanation)))
    is_stopped = bool(report.problem) or report.status >= FilterStatus.STOPPED
    return Review(
        verdict="rejected" if is_stopped else "modified",
        limit=str(report.limit),
        explanation="; ".join((report.problem or report.explanation, *clamps)),
    )
