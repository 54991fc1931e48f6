"""A kernel on a target behind the interface of the compiled kernel, with the host's kernel as its comparison channel.

Every step runs on both. The control that is written is the target's; row names and explanations come from the host. If
one bit of the results differs, the result is made inconsistent, so that the supervisor brakes and stops the robot.
"""

from __future__ import annotations

from math import copysign, inf, isnan, nan
from types import EllipsisType
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.compiled._kernel import Kernel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.kernel import kernel_model
from dualbrain.safety.cbf.result import FilterResult, RowNames
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.target.messages import (
    CYCLE,
    MOBILE,
    OPENING_KNOWN,
    YIELDING,
    CycleReply,
    Message,
    obstacle_frames,
    pack_held,
    pack_permits,
    pack_reset,
    pack_rows,
    padded,
)
from dualbrain.safety.target.session import TargetLostError, TargetSession

Array = NDArray[np.float64]
OPENING_TOLERANCE = 0.005
"""A measured opening may be outside the range of the gripper by this much [m], as in the binding of the kernel."""
MAX_FLOAT32 = 3.4028235e38
NO_BASE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


class TargetKernel:
    """The kernel on a target; other attributes than those below are the host kernel's."""

    def __init__(self, host: Kernel, session: TargetSession, robot_model: RobotModel, config: FilterConfig) -> None:
        """`host` is the host's kernel of the same robot and configuration, with an empty scene."""
        self._host, self.session, self._n = host, session, robot_model.n
        self._opening_max: float | None = kernel_model(robot_model, config).get("opening_max")
        self.board = session.description.board
        self._table, self._near = np.zeros((0, 29)), dict[int, tuple[float, ...]]()
        self._permits: dict[tuple[int, int], float] = {}
        self._scene_changed, self._permits_changed = True, True
        self._base, self._mobile = NO_BASE, False
        self._tick, self._action = (0, 0, 0, 0), 0
        self.reply: CycleReply | None = None
        """The last reply of the target."""
        self.lost = ""
        """Why the target was lost, "" while it answers."""
        self.steps, self.differences = 0, 0
        """Steps that both channels computed, and those with different bits."""
        self._clear_target()

    def _clear_target(self) -> None:
        """Bring the target into the state of a new filter: at rest, without a held object and additional rows."""
        self._send(Message.RESET, pack_reset([0.0] * self._n, [0.0] * self._n))
        self._send(Message.HELD, pack_held(np.zeros((0, 4)), 0.0))
        self._send(Message.ROWS, pack_rows(np.zeros((0, self._n + 3)), self._n))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._host, name)

    # --- scene ----------------------------------------------------------------------------------------------------

    def set_obstacles(self, rows: Array) -> None:
        """Replace the obstacle table."""
        if len(rows) > self.session.description.max_obstacles:
            allowed = f"at most {self.session.description.max_obstacles} on this target"
            raise ConfigurationError("obstacles at once", got=len(rows), allowed=allowed)
        self._host.set_obstacles(rows)
        self._table, self._near, self._scene_changed = rows, {}, True
        self.clear_permits()

    def limit_near(self, obstacle: int, speed: float, distance: float, brake: float, approach: float) -> None:
        """Limit the speed near one obstacle of the table."""
        self._host.limit_near(obstacle, speed, distance, brake, approach)
        self._near[obstacle] = (speed, distance, brake, approach)
        self._scene_changed = True

    def clear_permits(self) -> None:
        """Permit no contact."""
        self._host.clear_permits()
        self._permits, self._permits_changed = {}, True

    def permit(self, link: int, obstacle: int, speed: float) -> None:
        """Permit the contact of a link with an obstacle."""
        self._host.permit(link, obstacle, speed)
        self._permits[link, obstacle] = speed
        self._permits_changed = True

    def attach(self, spheres: Array, error: float) -> None:
        """Replace the spheres (k, 4) of the held object."""
        self._host.attach(spheres, error)
        self._send(Message.HELD, pack_held(spheres, error))

    def constrain(self, rows: Array) -> None:
        """Replace the additional rows (k, n + 3)."""
        self._host.constrain(rows)
        self._send(Message.ROWS, pack_rows(np.asarray(rows, float).reshape(-1, self._n + 3), self._n))

    def set_base_pose(self, pose: Array) -> None:
        """Pose of a mobile base for the next step."""
        self._host.set_base_pose(pose)
        self._base, self._mobile = tuple(pose.tolist()), True

    def reset(self, u_prev: Array, u_change: Array) -> None:
        """Set the last control and its last change."""
        self._host.reset(u_prev, u_change)
        self._send(Message.RESET, pack_reset(u_prev.tolist(), u_change.tolist()))

    def _send(self, kind: Message, payload: bytes) -> None:
        if self.lost:
            return
        try:
            self.session.send(kind, payload)
        except TargetLostError as error:
            self.lost = str(error)

    def _send_scene(self) -> None:
        if self._scene_changed:
            for kind, payload in obstacle_frames(self._table, self._near):
                self._send(kind, payload)
            self._permits_changed = bool(self._permits)  # a new table permits no contact
        if self._permits_changed:
            triples = [(link, obstacle, speed) for (link, obstacle), speed in self._permits.items()]
            self._send(Message.PERMITS, pack_permits(triples))
        self._scene_changed = self._permits_changed = False

    # --- ticks ----------------------------------------------------------------------------------------------------

    def supervise(self, now: float, stamp: float, conditions: int, *, yielding: bool, action: int = 0) -> None:
        """Conditions of the next step for the supervisor of the target, at `now` and with a state of `stamp` [s].

        `action` is the host's decision on them (`SafetyAction`).
        """
        times = (_microseconds(now), _microseconds(stamp))
        self._tick, self._action = (*times, conditions & (2**64 - 1), YIELDING * yielding), action

    def step(
        self,
        q: Array,
        v: Array,
        u_nom: Array,
        opening: float | EllipsisType,
        state_age: float,
        scene_age: float,
        names: RowNames,
    ) -> FilterResult:
        """One step on both channels; the opening is unknown to both if the target has no tables for it."""
        if not self.session.description.knows_opening:
            opening = ...
        result = self._host.step(q, v, u_nom, opening, state_age, scene_age, names)
        self.reply = None
        self._send_scene()
        if not self.lost:
            try:
                payload = self._cycle_payload(q, v, u_nom, opening, state_age, scene_age)
                self.reply = self.session.cycle(payload)
            except TargetLostError as error:
                self.lost = str(error)
        if self.reply is not None and self._agrees(result, self.reply):
            return result
        return msgspec.structs.replace(result, delta=nan)  # inconsistent: the supervisor brakes

    def _cycle_payload(
        self, q: Array, v: Array, u_nom: Array, opening: float | EllipsisType, state_age: float, scene_age: float
    ) -> bytes:
        now, stamp, conditions, options = self._tick
        known = not isinstance(opening, EllipsisType)
        options |= OPENING_KNOWN * known | MOBILE * self._mobile
        reals = [value for values in (q, v, u_nom) for value in padded(np.asarray(values, float).tolist())]
        ages = (0.0 if isinstance(opening, EllipsisType) else self._plausible_opening(opening), state_age, scene_age)
        return CYCLE.pack(now, stamp, conditions, *map(_single, (*reals, *ages)), options, *map(_single, self._base))

    def _plausible_opening(self, opening: float) -> float:
        """The opening as the kernel gets it: NaN, which it rejects, if the gripper cannot be open that far."""
        most = self._opening_max
        if most is None or -OPENING_TOLERANCE <= opening <= most + OPENING_TOLERANCE:
            return float(opening)
        return nan

    def _agrees(self, result: FilterResult, reply: CycleReply) -> bool:
        """Whether the results of both channels have the same bits; the control of a standstill is zero on both."""
        self.steps += 1
        zero = reply.at_standstill or not reply.drive_enabled
        same = (
            (zero or reply.u[: self._n].tobytes() == result.u.astype(np.float32).tobytes())
            and (int(result.status), result.flags, result.iterations, result.n_rows, result.relaxed_mask)
            == (reply.status, reply.flags, reply.iterations, reply.n_rows, reply.relaxed)
            and all(map(_equal, (result.delta, result.h_min), (reply.delta, reply.h_min)))
        )
        self.differences += not same
        return same

    def conditions(self) -> int:
        """Conditions of the target for the next decision: those that it detected itself, its own stop, or its loss."""
        if self.lost:
            return int(Condition.PROGRAM_ERROR)
        return self.reply.conditions | self._stop_condition(self.reply.action) if self.reply is not None else 0

    def _stop_condition(self, action: int) -> int:
        """The condition of a stop that only the target has decided on; a stop of both ends on each by itself."""
        if action >= SafetyAction.ESTOP > self._action:
            return int(Condition.ESTOP)
        return int(Condition.STATE_STALE) if action >= SafetyAction.CONTROLLED_STOP > self._action else 0


def _microseconds(seconds: float) -> int:
    """A time in the unit of the target; a time that is not finite, or before zero, counts as zero."""
    return min(int(seconds * 1e6 + 0.5), 2**63) if 0.0 <= seconds < 1e12 else 0


def _single(value: float) -> float:
    """The value as the kernel rounds it: beyond float32 it is infinite."""
    return copysign(inf, value) if abs(value) > MAX_FLOAT32 else value


def _equal(a: float, b: float) -> bool:
    return a == b or (isnan(a) and isnan(b))
