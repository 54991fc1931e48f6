"""Contact force: the force at the tool, or at the link, that explains the external joint torque best.

For a point with the Jacobian J (3, k), the force is the damped least-squares solution

    F = (J Jᵀ + λ² 1)⁻¹ J r,      λ = `DAMPING`,      cost = ‖r − JᵀF‖² + λ² ‖F‖²

over the k joints before the point; the joints behind it are not moved by F. The tool is assumed first. If it leaves
more than `UNEXPLAINED_SHARE` of r, the collision sphere with the least cost is the place of contact. A contact before
the third joint cannot be resolved; its torque then counts as a force at the nearest place that can.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import RobotModel

Array = NDArray[np.float64]

DAMPING = 0.05
"""Damping λ [m]: directions in which a force has a shorter lever than this are not resolved."""
UNEXPLAINED_SHARE = 0.3
"""Share of the external torque that a force at the tool may leave unexplained."""
LEAST_TORQUE = 1.0
"""External torque [Nm] of a joint below which no other place than the tool is looked for."""
LEAST_JOINTS = 3
"""Number of joints that resolve the three components of a force."""
NOISE_FACTOR = 3.0
"""Standard deviations of the noise that count as its bound."""
TOOL = "tool"


@dataclass(frozen=True, slots=True, kw_only=True)
class ContactForce:
    """The estimated contact force at `stamp` [s].

    `vector` (3,) [N] acts on the robot, in the axes of the world, at `place`: "tool" or the name of a link.
    `uncertainty` [N] is the part of it that noise and accuracy of the sensor may cause. `load` [kg] is the weight in
    the hand that is not part of the force, `felt_load` [kg] the weight that is felt now, contact forces included.
    """

    stamp: float
    vector: tuple[float, float, float]
    magnitude: float
    place: str
    uncertainty: float
    load: float
    felt_load: float

    def explain(self, limit: float) -> str:
        """The force against its `limit` [N] as a sentence."""
        where = "the tool" if self.place == TOOL else self.place
        return (
            f"a force of {self.magnitude:.0f} N (± {self.uncertainty:.0f} N) acts on {where}, allowed are "
            f"{limit:.0f} N; remedy: look for an object that perception does not see"
        )


class ForceSolver:
    """Solves for the force at the tool or at a link of one robot."""

    def __init__(self, robot_model: RobotModel, first_joint: int) -> None:
        """`first_joint` is the index of the arm's first joint among the controls."""
        sensing = robot_model.force_sensing
        self._first, self._n = first_joint, robot_model.n - first_joint
        links = [link for link in robot_model.links for sphere in robot_model.spheres if sphere.link == link.name]
        self._links = [link.name for link in links]
        joints_before = np.array([link.frame - first_joint for link in links])
        self._eligible = np.flatnonzero(joints_before >= LEAST_JOINTS)
        self._moved = np.arange(self._n) < joints_before[self._eligible][:, None]
        self._prismatic = np.array([joint.kind == "prismatic" for joint in robot_model.joints[first_joint:]])
        margin = np.array(sensing.accuracy) + NOISE_FACTOR * np.array(sensing.noise) if sensing else np.zeros(0)
        self._margin = margin[first_joint:]
        self.wrist_uncertainty = float(np.linalg.norm(margin[:3]))
        """The largest error [N] of the force of a wrist sensor."""

    def at_tool(self, residual: Array, jacobian: Array) -> tuple[Array, Array, float]:
        """Force (3,), the map (3, n) from torque to force, and the share of `residual` (n,) that stays unexplained.

        `jacobian` (3, n) is that of the tool's position for the joints of the arm.
        """
        solve = np.linalg.solve(jacobian @ jacobian.T + DAMPING**2 * np.eye(3), jacobian).astype(np.float64)
        force = solve @ residual
        left = residual - jacobian.T @ force
        size = float(residual @ residual)
        return force, solve, float(left @ left) / size if size > 0.0 else 0.0

    def uncertainty(self, solve: Array) -> float:
        """The largest force [N] that noise and accuracy of the sensor cause, for a map (3, n) from torque to force."""
        return float(np.linalg.norm(np.abs(solve) @ self._margin))

    def at_links(self, residual: Array, jacobian: Array, tool: Array, centres: Array) -> tuple[Array, Array, str]:
        """Force (3,), its map (3, n) and the link of the collision sphere that explains `residual` (n,) best.

        `jacobian` (6, n) is that of the tool frame at `tool` (3,), `centres` (k, 3) are those of the robot's spheres.
        """
        arms = centres[self._eligible] - tool
        turning = np.where(self._prismatic, 0.0, jacobian[3:])
        moved = np.cross(turning.T[None], arms[:, None])  # (k, n, 3)
        levers = (jacobian[:3].T[None] + moved) * self._moved[:, :, None]
        gram = levers.transpose(0, 2, 1) @ levers + DAMPING**2 * np.eye(3)
        solve = np.linalg.solve(gram, levers.transpose(0, 2, 1)).astype(np.float64)
        forces = solve @ residual
        left = residual - (levers @ forces[:, :, None])[:, :, 0]
        cost = np.sum(left**2, axis=1) + DAMPING**2 * np.sum(forces**2, axis=1)
        best = int(np.argmin(cost))
        return forces[best], solve[best], self._links[int(self._eligible[best])]
