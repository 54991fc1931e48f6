"""Monitor of the contact force: from measured states to the estimate, the stop and the speed of permitted contacts."""

from __future__ import annotations

from math import hypot

import numpy as np

from dualbrain.robots.interface import Array, RobotState
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.kernel import tool_frame
from dualbrain.safety.contact_force.estimate import LEAST_TORQUE, TOOL, UNEXPLAINED_SHARE, ContactForce, ForceSolver
from dualbrain.safety.contact_force.external_torque import WINDOW, ExternalTorque
from dualbrain.safety.contact_force.limits import ContactForceLimits, stop_force
from dualbrain.safety.contact_force.permitted_speed import PermittedSpeed


class ContactForceMonitor:
    """Contact force of one robot with force sensing.

    State: `force`, the newest estimate or None, `fastest_permit` [m/s], the largest permitted contact speed or None if
    no contact is permitted, and `permitted_speed`.
    """

    def __init__(self, safety: SafetyFilter, limits: ContactForceLimits | None = None) -> None:
        """Use the kinematics of `safety`; raises `ConfigurationError` without a dynamic model."""
        self.limits = limits or ContactForceLimits()
        self._safety = safety
        self.external_torque = ExternalTorque(safety.robot_model)
        self._first = self.external_torque.dynamics.first_joint
        self._solver = ForceSolver(safety.robot_model, self._first)
        self._last_frame_to_tool, _ = tool_frame(safety.robot_model)
        self.permitted_speed = PermittedSpeed(self.limits)
        self.fastest_permit: float | None = None
        self.force: ContactForce | None = None
        self.joint_torque: Array | None = None
        """External torque (k,) of the arm's k joints [Nm] that belongs to `force`."""
        self.yielding = False
        """Whether a permitted contact is above its permitted force, so that the arm must give way."""
        self._above_since: float | None = None
        self._exceeded = ""

    def set_permits(self, fastest: float | None) -> None:
        """The largest speed [m/s] of the permitted contacts from now on; None without any."""
        self.fastest_permit = fastest
        if fastest is None:
            self.permitted_speed.reset()

    def set_holding(self, holding: bool, now: float) -> None:
        """Whether an object is in the hand from `now` [s] on."""
        self.external_torque.set_holding(holding, now)

    @property
    def limit(self) -> float:
        """The force [N] that stops the arm now."""
        return stop_force(self.limits, permitted=self.fastest_permit is not None)

    @property
    def is_exceeded(self) -> bool:
        """Whether the force is above `limit` and above the error of the estimate."""
        return self.force is not None and self.force.magnitude > max(self.limit, self.force.uncertainty)

    def update(self, state: RobotState) -> bool:
        """Add a measured state; whether the force is above `limit`, with a permit for longer than `stop_time`."""
        updated, residual = self.external_torque.update(state), self.external_torque.residual
        if residual is None:
            self.force = self.joint_torque = None
        elif updated:
            self.force = self._estimate(state, residual)
            if self.fastest_permit is not None:
                self.permitted_speed.update(self.force.magnitude, self.fastest_permit, WINDOW)
        self.yielding = self._must_yield()
        if self.force is None or not self.is_exceeded:
            self._above_since = None
            return False
        if self._above_since is None:
            self._above_since = state.stamp
        if self.fastest_permit is not None and state.stamp - self._above_since < self.limits.stop_time.value:
            return False
        self._exceeded = self.force.explain(self.limit)
        return True

    def _must_yield(self) -> bool:
        """Whether a permitted contact is above its permitted force, with hysteresis."""
        if self.force is None or self.fastest_permit is None:
            return False
        share = self.limits.release_share.value if self.yielding else 1.0
        return self.force.magnitude > max(share * self.limits.permitted.value, self.force.uncertainty)

    def explain(self) -> str:
        """The force that stopped the arm last, as a sentence; "" if none did."""
        return self._exceeded

    def _estimate(self, state: RobotState, residual: Array) -> ContactForce:
        """The contact force that explains `residual`, of the joints (n,) or at the wrist (6,)."""
        tool = self._safety.tool(state.q)
        if self.external_torque.at_wrist:
            force = tool.rotation @ (self._last_frame_to_tool.T @ residual[:3])
            self.joint_torque = tool.jacobian[:3, self._first :].T @ force
            return self._contact_force(state, force, self._solver.wrist_uncertainty, TOOL)
        self.joint_torque = residual
        solution = self._solver.at_tool(residual, tool.jacobian)
        if solution.unexplained > UNEXPLAINED_SHARE and np.abs(residual).max() > LEAST_TORQUE:
            centres, _, _ = self._safety.spheres(state.q, state.opening)
            solution = self._solver.at_links(residual, tool.jacobian, tool.position, centres)
        return self._contact_force(state, solution.vector, self._solver.uncertainty(solution), solution.place)

    def _contact_force(self, state: RobotState, vector: Array, uncertainty: float, place: str) -> ContactForce:
        x, y, z = vector.tolist()
        return ContactForce(
            stamp=state.stamp,
            vector=(x, y, z),
            magnitude=hypot(x, y, z),
            place=place,
            uncertainty=uncertainty,
            load=self.external_torque.load,
            felt_load=self.external_torque.felt_load,
        )
