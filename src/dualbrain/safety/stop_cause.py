"""Causes of a stop: one code for every way in which a filter returns STOPPED or FAULT, with a text and a remedy."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntFlag, StrEnum
from typing import Protocol

import msgspec
import numpy as np
from numpy.typing import ArrayLike

OBSTACLE_ROW = 0
"""Kind of an obstacle row in the kernel's numbering; see `cbf.result`."""
INPUT_NAMES = ("q", "v", "u_nom", "opening", "rotation of the base", "position of the base")
"""Names of the inputs of a step, in the numbering of `kernel/python/stop_evidence.cpp`."""
MAX_LEAD = 5e-3
"""Skew of the clocks [s] that the kernel tolerates."""


class Reason(IntFlag):
    """Reasons for the status of a step; several may apply. The bits are those of the kernel.

    JERK and OVERSPEED are for information and occur with every status; UNVERIFIED also occurs with MODIFIED. RETREAT
    occurs with INFEASIBLE in a RELAXED step: each row that cannot be satisfied is of an obstacle that the robot evades.
    """

    BAD_INPUT = 1
    STALE_STATE = 2
    STALE_SCENE = 4
    OUTSIDE_LIMITS = 8
    ROW_OVERFLOW = 16
    NO_GRADIENT = 32
    QP_ITERATIONS = 64
    INFEASIBLE = 128
    BAD_SCENE = 256
    UNCERTIFIED = 512
    UNAVOIDABLE = 1024
    JERK = 2048
    UNVERIFIED = 4096
    OVERSPEED = 8192
    RETREAT = 16384


class StopCause(StrEnum):
    """The cause of a STOPPED or FAULT: the code that a program reads.

    STOPPED has one of the causes up to QP_ITERATIONS, FAULT one of the others. UNKNOWN is a defect of the filter: a
    stop without a reason.
    """

    BAD_INPUT = "bad input"
    BAD_SCENE = "bad scene"
    STALE_STATE = "stale state"
    STALE_SCENE = "stale scene"
    OUTSIDE_LIMITS = "outside limits"
    ROW_OVERFLOW = "row overflow"
    NO_GRADIENT = "no gradient"
    QP_ITERATIONS = "qp iterations"
    UNVERIFIED = "unverified"
    UNAVOIDABLE = "unavoidable"
    INFEASIBLE = "infeasible"
    UNCERTIFIED = "uncertified"
    UNKNOWN = "unknown"


REASON_TEXTS = {
    "BAD_INPUT": "the input holds a number that is not finite",
    "STALE_STATE": "the joint state is too old, or the clock stepped",
    "STALE_SCENE": "moving things were seen too long ago",
    "OUTSIDE_LIMITS": "a joint is far outside its range",
    "ROW_OVERFLOW": "more pairs are near than there is room for (shorten the control period or clear the scene)",
    "NO_GRADIENT": "something is inside the robot where no joint can move it away",
    "QP_ITERATIONS": "the optimisation did not end in time",
    "INFEASIBLE": "no control meets all of",
    "BAD_SCENE": "the obstacles, a constraint row or the grasped object cannot be used",
    "UNCERTIFIED": "not even braking keeps clear",
    "UNAVOIDABLE": "something comes at a part that cannot move away",
    "OVERSPEED": "no control was found that keeps the speed limits; no part above its limit is clearly faster than "
    "under braking",
    "RETREAT": "the retreat ends the approach of the obstacle in time",
    "UNVERIFIED": "the independent check rejected the solution of the optimisation",
}
"""Texts of the reasons. They become part of outcomes, and so of the prompt of a planner that plans again."""

REMEDIES = {
    StopCause.BAD_INPUT: "pass finite numbers; check the sensor, or the controller that computes the nominal control",
    StopCause.BAD_SCENE: "correct this obstacle, and observe the scene again",
    StopCause.STALE_STATE: "pass a newer joint state and `now` on the clock of its stamp, or raise "
    "FilterConfig.state_stale_after",
    StopCause.STALE_SCENE: "observe the moving obstacles again with a stamp on the clock of `now`, or raise "
    "FilterConfig.scene_stale_after",
    StopCause.OUTSIDE_LIMITS: "move the joint back with the manufacturer's program, or correct its limits in the robot "
    "model",
    StopCause.ROW_OVERFLOW: "shorten the control period, lower the velocity limits, or merge obstacles",
    StopCause.NO_GRADIENT: "remove this obstacle, or correct its pose, or the collision spheres of the robot model",
    StopCause.QP_ITERATIONS: "call the filter again in the next period; if it lasts, merge obstacles that are close to "
    "each other, and report the scene as a defect",
    StopCause.UNVERIFIED: "call the filter again in the next period; if it lasts, use precision='float64', and report "
    "the state as a defect",
    StopCause.UNAVOIDABLE: "keep moving obstacles away from the base of the robot, or stop them",
    StopCause.INFEASIBLE: "move slower near obstacles, or lower FilterConfig.alpha, so that the robot can brake within "
    "its acceleration limits",
    StopCause.UNCERTIFIED: "stop the robot and increase the distance of this pair; check the tracking error of the "
    "drives, the poses and margins of obstacles, and the speed at which the filter takes over (`reset`)",
    StopCause.UNKNOWN: "report this state as a defect of the filter",
}
"""What to do, by cause. A sentence of `explain` ends with it."""

MAX_REFUSAL_LENGTH = 300
"""Largest length of the message of a refused update in an explanation [characters]."""


class Evidence(msgspec.Struct, frozen=True, kw_only=True, array_like=True):
    """The numbers behind one reason of a stop, from the kernel.

    `flag` is the bit of the reason. `kind`, `i` and `j` identify the input, obstacle, joint or pair. `value` is the
    value that was rejected and `limit` the allowed one; for UNCERTIFIED they are h now and after one period [m].
    """

    flag: int
    kind: int
    i: int
    j: int
    value: float
    limit: float


class IndexNames(Protocol):
    """Names for the indices of the kernel."""

    @property
    def obstacles(self) -> tuple[str, ...]:
        """Names of the obstacles."""
        ...

    @property
    def refusal(self) -> str:
        """The reason why the last update of the scene was refused, "" if it was not."""
        ...

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        ...

    def row_name(self, kind: int, i: int, j: int) -> str:
        """Name of a row."""
        ...


def stop_cause(flags: int) -> StopCause:
    """The cause of a stop with these bits of `Reason`: the first one in the order of `StopCause`."""
    for cause in StopCause:
        if cause is not StopCause.UNKNOWN and flags & Reason[cause.name]:
            return cause
    return StopCause.UNKNOWN


def stop_remedy(flags: int) -> str:
    """The end of an explanation: "remedy: ..."."""
    return f"remedy: {REMEDIES[stop_cause(flags)]}"


def describe_not_finite(**values: ArrayLike) -> str:
    """The first number that is not finite, as "q[2] is nan"; empty if all are finite."""
    for name, value in values.items():
        array = np.asarray(value, float)
        bad = np.flatnonzero(~np.isfinite(array))
        if len(bad):
            index = f"[{bad[0]}]" if array.ndim else ""
            return f"{name}{index} is {array.flat[bad[0]]:g}"
    return ""


def describe_refusal(error: BaseException) -> str:
    """The message of a refused update on one line, cut after `MAX_REFUSAL_LENGTH` characters."""
    return " ".join(str(error).split())[:MAX_REFUSAL_LENGTH]


def describe_age(age: float, limit: float) -> str:
    """An age [s] and the largest allowed one."""
    return f"age {age * 1e3:.1f} ms, allowed are {-MAX_LEAD * 1e3:.0f} to {limit * 1e3:.0f} ms"


def describe_position(joint: str, value: float, limit: float) -> str:
    """A joint position that is outside its limits."""
    return f"{joint} at {value:.3f}, its limit is {limit:.3f} [rad or m]"


def describe_evidence(evidence: Evidence, names: IndexNames) -> str:
    """The numbers of one reason in words; empty for a reason that has no text of its own."""
    describe = _DESCRIPTIONS.get(Reason(evidence.flag))
    return describe(evidence, names) if describe else ""


def _describe_input(e: Evidence, names: IndexNames) -> str:
    del names
    name = INPUT_NAMES[e.kind]
    if name == "opening":
        return f"the opening is {e.value:g} m, allowed is at most {e.limit:g} m"
    return f"{name}[{e.i}] is {e.value:g}"


def _describe_scene(e: Evidence, names: IndexNames) -> str:
    if names.refusal:
        return f"the last update was refused: {names.refusal}"
    if e.i < len(names.obstacles):
        return f"obstacle {e.i} of {len(names.obstacles)}, {names.obstacles[e.i]!r}, is not valid"
    return f"all {len(names.obstacles)} obstacles are valid, but a constraint row or the grasped object is not"


def _describe_age(e: Evidence, names: IndexNames) -> str:
    del names
    return describe_age(e.value, e.limit)


def _describe_joint(e: Evidence, names: IndexNames) -> str:
    return describe_position(names.joints[e.i], e.value, e.limit)


def _describe_overflow(e: Evidence, names: IndexNames) -> str:
    del names
    return f"{e.value:.0f} of at most {e.limit:.0f} rows, {e.i} of at most {e.j} groups of pairs"


def _describe_pair(e: Evidence, names: IndexNames) -> str:
    return f"{names.row_name(e.kind, e.i, e.j)} at {e.value * 1e3:.1f} mm"


def _describe_iterations(e: Evidence, names: IndexNames) -> str:
    del names
    return f"{e.value:.0f} of at most {e.limit:.0f} iterations"


def _describe_next_state(e: Evidence, names: IndexNames) -> str:
    pair = names.row_name(e.kind, e.i, e.j)
    return f"{pair} goes from h = {e.value * 1e3:.4g} mm to {e.limit * 1e3:.4g} mm in one period"


_DESCRIPTIONS: dict[Reason, Callable[[Evidence, IndexNames], str]] = {
    Reason.BAD_INPUT: _describe_input,
    Reason.BAD_SCENE: _describe_scene,
    Reason.STALE_STATE: _describe_age,
    Reason.STALE_SCENE: _describe_age,
    Reason.OUTSIDE_LIMITS: _describe_joint,
    Reason.ROW_OVERFLOW: _describe_overflow,
    Reason.NO_GRADIENT: _describe_pair,
    Reason.UNAVOIDABLE: _describe_pair,
    Reason.QP_ITERATIONS: _describe_iterations,
    Reason.UNCERTIFIED: _describe_next_state,
}
