"""External joint torque: the part of the motion that neither the motors nor the robot's own dynamics explain.

With the measured motor torque τ and the model M, c, g of the arm, over windows of T (`WINDOW`):

    r_w = M(q̄) (v_end − v_begin)/T + c(q̄, v̄) + g(q̄) − τ̄          means over the window
    r  ← r + (1 − e^(−T/T_f)) (r_w − r)                              T_f = `FILTER_TIME`

This is the generalised-momentum observer in discrete time (De Luca and Mattone, ICRA 2005): M Δv is the change of
momentum, so no acceleration is differentiated from positions. Without contact r is the load in the hand and the error
of model and sensor; a force F at a point with the Jacobian J adds JᵀF. The load m is identified from

    m_w = −r·p/(p·p)          p: torque of 1 kg at the tool

within `LOAD_TIME` after a grasp, between 0 and the payload, and is constant afterwards, so that a later contact is not
mistaken for weight.
"""

from __future__ import annotations

from math import exp, isfinite

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.contact_force.arm_dynamics import ArmDynamics, ArmTorque

Array = NDArray[np.float64]

WINDOW = 0.004
"""Length T of a window [s]; one estimate per window."""
FILTER_TIME = 0.004
"""Time constant T_f of the residual [s]."""
LOAD_FILTER_TIME = 0.2
"""Time constant [s] of the identified load."""
LOAD_TIME = 2.0
"""Time [s] after a grasp in which the load is identified."""
MAX_VELOCITY_GAP = 0.05
"""Largest difference [rad/s] of the velocity from positions and the measured one, beyond half of its change."""
MAX_GAP_WINDOWS = 3.0
"""A longer gap between two states [windows] begins a new window."""


class ExternalTorque:
    """The residual of one robot; `update` takes every measured state.

    State: `residual` (n,) of the arm's joints [Nm] without the load in the hand, or for a wrist sensor the wrench (6,)
    on the last frame, None until the first window is complete; `load` [kg], and `felt_load` [kg], which is identified
    continuously and may contain contact forces.
    """

    def __init__(self, robot_model: RobotModel) -> None:
        """Start without a window; raises `ConfigurationError` without a dynamic model."""
        self.dynamics = ArmDynamics(robot_model)
        sensing, dynamics = robot_model.force_sensing, robot_model.dynamics
        self.at_wrist = sensing is not None and sensing.kind == "wrist_wrench"
        self._payload = dynamics.payload.value if dynamics else 0.0
        self.residual: Array | None = None
        self.load = self.felt_load = 0.0
        self._held_since: float | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the window and the residual; the load in the hand remains."""
        self.residual = None
        self._raw: Array | None = None
        self._previous: RobotState | None = None
        self._first: RobotState | None = None
        self._sum: Array | None = None
        self._complete: tuple[RobotState, RobotState, Array] | None = None

    def set_holding(self, holding: bool, now: float) -> None:
        """Begin to identify a load at `now` [s] (state stamps), or assume an empty hand."""
        self._held_since = now if holding else None
        self.load = self.felt_load = 0.0

    def measures(self, state: RobotState) -> bool:
        """Whether the robot delivers the reading that its model declares."""
        return (state.wrench if self.at_wrist else state.torques) is not None

    def update(self, state: RobotState) -> bool:
        """Add one state; whether `residual` is new. A state without a measurement ends the window.

        A window is evaluated one state after its end, when that state has shown that the last velocity was none of a
        failed sensor.
        """
        reading, previous = self._reading(state), self._previous
        if reading is None:
            self.reset()
            return False
        self._previous = state
        if previous is None or not self._continues(previous, state):
            self.reset()
            self._previous = self._first = state
            return False
        finished, self._complete = self._complete, None
        if finished is not None:
            self._evaluate(finished)
        gap = state.stamp - previous.stamp
        self._sum = gap * reading if self._sum is None else self._sum + gap * reading
        first = self._first or previous
        if state.stamp - first.stamp >= WINDOW * (1.0 - 1e-6):
            self._complete = (first, state, self._sum / (state.stamp - first.stamp))
            self._first, self._sum = state, None
        return finished is not None

    def _continues(self, previous: RobotState, state: RobotState) -> bool:
        """Whether `state` follows `previous`: in time, and with positions and velocities of one motion.

        A sensor that fails must not look like a contact, in which the velocity changes as fast.
        """
        gap = state.stamp - previous.stamp
        if not 0.0 < gap <= MAX_GAP_WINDOWS * WINDOW:
            return False
        moved, before, after = (state.q - previous.q).tolist(), previous.v.tolist(), state.v.tolist()
        if (bases := len(moved) - self.dynamics.n) > 0:
            moved, before, after = (
                moved[bases:],
                before[self.dynamics.first_joint :],
                after[self.dynamics.first_joint :],
            )
        for change, slow, fast in zip(moved, before, after, strict=True):
            if not abs(change / gap - 0.5 * (slow + fast)) - 0.5 * abs(fast - slow) <= MAX_VELOCITY_GAP:
                return False
        return True

    def _reading(self, state: RobotState) -> Array | None:
        """The arm's torques, or the wrench at the wrist; None without a usable one."""
        reading = state.wrench if self.at_wrist else state.torques
        if reading is None or not state.drive_enabled or not isfinite(sum(reading.tolist())):
            return None
        return reading if self.at_wrist else reading[self.dynamics.first_joint :]

    def _evaluate(self, window: tuple[RobotState, RobotState, Array]) -> None:
        """Add the residual of a window to the filtered one, and remove the load."""
        first, last, reading = window
        time = last.stamp - first.stamp
        expected = self.dynamics.torque(0.5 * (first.q + last.q), 0.5 * (first.v + last.v), (last.v - first.v) / time)
        own, per_load = self._expectation(expected)
        new = own - reading
        share = 1.0 - exp(-time / FILTER_TIME)
        self._raw = share * new if self._raw is None else self._raw + share * (new - self._raw)
        self._identify_load(self._raw, per_load, last.stamp, time)
        self.residual = self._raw + self.load * per_load

    def _expectation(self, expected: ArmTorque) -> tuple[Array, Array]:
        if self.at_wrist:
            return expected.wrist, expected.wrist_per_load
        return expected.own, expected.per_load

    def _identify_load(self, raw: Array, per_load: Array, now: float, time: float) -> None:
        if self._held_since is None:
            return
        size = float(per_load @ per_load)
        felt = -float(per_load @ raw) / size if size > 1e-9 else 0.0
        share = 1.0 - exp(-time / LOAD_FILTER_TIME)
        self.felt_load += share * (min(max(felt, 0.0), self._payload) - self.felt_load)
        if now - self._held_since <= LOAD_TIME:
            self.load = self.felt_load
