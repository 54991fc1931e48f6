"""Contact force: the force at the tool, or at the link, that explains the external joint torque best.

For a point with the Jacobian J (3, k), the force is the damped least-squares solution

    F = (J Jᵀ + λ² 1)⁻¹ J r,      λ = `DAMPING`,      cost = ‖r − JᵀF‖² + λ² ‖F‖²

over the k joints before the point; the joints behind it are not moved by F. The tool is assumed first. If it leaves
more than `UNEXPLAINED_SHARE` of r, the collision sphere with the least cost is the place of contact. A contact before
the third joint cannot be resolved; its torque then counts as a force at the nearest place that can.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.compiled import _kernel64_wide as compiled

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


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceSolution:
    """A force (3,) [N] at `place`, and the map (3, n) from the external torque to it.

    `unexplained` is the share of the squared torque that the force leaves.
    """

    vector: Array
    torque_to_force: Array
    unexplained: float
    place: str


class ForceSolver:
    """Solves for the force at the tool or at a link of one robot."""

    def __init__(self, robot_model: RobotModel, first_joint: int) -> None:
        """`first_joint` is the index of the arm's first joint among the controls."""
        sensing = robot_model.force_sensing
        self._n = robot_model.n - first_joint
        links = [link for link in robot_model.links for sphere in robot_model.spheres if sphere.link == link.name]
        self._links = [link.name for link in links]
        joints_before = np.array([link.frame - first_joint for link in links])
        self._eligible = np.flatnonzero(joints_before >= LEAST_JOINTS)
        self._joints_before = joints_before[self._eligible].astype(np.int32)
        margin = np.array(sensing.accuracy) + NOISE_FACTOR * np.array(sensing.noise) if sensing else np.zeros(0)
        self._margin = margin[first_joint:]
        self.wrist_uncertainty = float(np.linalg.norm(margin[:3]))
        """The largest error [N] of the force of a wrist sensor."""

    def at_tool(self, torque: Array, jacobian: Array) -> ForceSolution:
        """The force at the tool for the external `torque` (n,), with the Jacobian (6, n) of the tool frame.

        The Jacobian of a mobile robot has the columns of its base first.
        """
        flat = self._buffer()
        compiled.contact_force(jacobian, torque, DAMPING**2, flat)
        return self._solution(flat, torque, TOOL)

    def at_links(self, torque: Array, jacobian: Array, tool: Array, centres: Array) -> ForceSolution:
        """The force at the collision sphere that explains the external `torque` (n,) best.

        `jacobian` is that of the tool frame at `tool` (3,), `centres` (k, 3) are those of the robot's spheres.
        """
        flat = self._buffer()
        points = centres[self._eligible]
        best = compiled.locate_contact(jacobian, tool, points, self._joints_before, torque, DAMPING**2, flat)
        return self._solution(flat, torque, self._links[int(self._eligible[best])])

    def uncertainty(self, solution: ForceSolution) -> float:
        """The largest force [N] that noise and accuracy of the sensor cause."""
        x, y, z = (np.abs(solution.torque_to_force) @ self._margin).tolist()
        return hypot(x, y, z)

    def _buffer(self) -> Array:
        return np.empty(4 + 3 * self._n)

    def _solution(self, flat: Array, torque: Array, place: str) -> ForceSolution:
        size, left = float(torque @ torque), flat[-1].item()
        return ForceSolution(
            vector=flat[:3],
            torque_to_force=flat[3:-1].reshape(3, self._n),
            unexplained=left / size if size > 0.0 else 0.0,
            place=place,
        )
