"""What an order makes of the control and of the drive: slow down, stand still and be watched, brake, switch off.

    u_nom' = s u_nom      with s = 1 (NONE, WARN), the speed stage (SLOW), 0 (HOVER and above): then the filter
    u      = 0            once a HOLD or CONTROLLED_STOP has come to rest; the joints are watched from there

The nominal control is scaled *before* the filter, so that nothing changes u after its certificate; the zero of a
standstill is written only when the arm already rests.
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.interface import RobotState
from dualbrain.safety.supervisor.actions import Order, Rung
from dualbrain.safety.supervisor.conditions import Condition

Array = NDArray[np.float64]

C = Condition


class Standstill(msgspec.Struct, frozen=True):
    """When an arm counts as standing: `rest` [rad/s], `drift` allowed from there [rad].

    `stop` [s] is the longest that braking may take; `brakes` [s] what the brakes need to bring the arm to rest, `fall`
    [rad] how far it may move beyond what it would coast in that time; `slow` is the scale of SLOW where no speed stage
    is chosen.
    """

    rest: float = 0.01
    drift: float = 0.01
    stop: float = 0.8
    brakes: float = 0.4
    fall: float = 0.03
    slow: float = 0.5


class Enforcement:
    """Keeps what an order needs from tick to tick: since when, where the arm stood, whether the drive is wanted."""

    def __init__(self, dials: Standstill | None = None) -> None:
        """The drive is wanted, no order is in force."""
        self.dials = dials or Standstill()
        self.driving = True
        self.anchor: Array | None = None
        self._since: float | None = None
        self._off_at: float | None = None
        self._off_q = self._coast = np.zeros(0)

    def scale(self, order: Order, stage: float) -> float:
        """S in [0, 1]: what is left of the nominal control; `stage` is the speed that a person has chosen."""
        if order.action >= Rung.HOVER:
            return 0.0
        if order.action < Rung.SLOW:
            return 1.0
        return stage if order.check == "speed_stage" else min(stage, self.dials.slow)

    @property
    def standing(self) -> bool:
        """Whether u = 0 is to be written: the arm has come to rest under an order to stand."""
        return self.anchor is not None

    def obey(self, order: Order, state: RobotState) -> int:
        """Take in the order and the measured state; returns the `Condition` bits that a broken standstill sets.

        Time here is the robot's own (its stamps), so that a broken clock cannot make a stop look overdue.
        Sets `driving` and `standing`, which the local layer acts on.
        """
        flags = self._drive(order, state)
        if order.action < Rung.HOLD or not self.driving:
            self._since, self.anchor = None, None
            return flags
        if self._since is None:
            self._since = state.stamp
        if self.anchor is None:
            if np.abs(state.v).max() < self.dials.rest:
                self.anchor = state.q.copy()
            elif not state.stamp - self._since <= self.dials.stop:
                flags |= C.STOP_OVERDUE
        elif not strayed(self.anchor, state).max() <= self.dials.drift:
            flags |= C.DRIFT
        if order.action >= Rung.CONTROLLED_STOP and self.anchor is not None:
            self._switch(state, driving=False)
        return flags

    def _drive(self, order: Order, state: RobotState) -> int:
        """Off at once for ESTOP or `Order.at_once`; on again below CONTROLLED_STOP; while off, the brakes must hold."""
        if (order.action >= Rung.ESTOP or order.at_once) and self.driving:
            self._switch(state, driving=False)
        elif order.action < Rung.CONTROLLED_STOP and not self.driving:
            self._switch(state, driving=True)
        if self.driving or self._off_at is None or not state.stamp > self._off_at:  # nothing is known since
            return 0
        moved = strayed(self._off_q, state)
        braked = state.stamp - self._off_at > self.dials.brakes
        fast = braked and not np.abs(state.v).max() <= 10.0 * self.dials.rest
        return C.FALLING if fast or not (moved <= self._coast).all() else 0

    def _switch(self, state: RobotState, *, driving: bool) -> None:
        self.driving, self._off_at, self._off_q = driving, None if driving else state.stamp, state.q.copy()
        self._coast = self.dials.fall + self.dials.brakes * np.abs(state.v)


def strayed(q: Array, state: RobotState) -> Array:
    """How far each control's part (n,) has come from `q` [m, rad]; of a base the way, in whatever direction."""
    moved = np.abs(state.q - q)
    return moved if len(q) == len(state.v) else np.array([np.hypot(moved[0], moved[1]), *moved[2:]])
