"""mink: `CollisionAvoidanceLimit` between the arm's spheres and the obstacles, solved by DAQP through `solve_ik`.

Rows: all pairs by MuJoCo, built one by one in Python; with the broadphase (its default) only pairs nearer than the
detection distance, which at 0.1 m omits rows that would bind: a smaller problem than that of the other filters. The
variable of the QP is a displacement and its bound is gain · distance / dt, so a control barrier function needs
gain = α dt². Joint limits: gain α dt. The nominal control enters as a posture target q + u_nom dt. Obstacles are mocap
bodies; `step_statistics` reports dropped pairs.
"""

from __future__ import annotations

import mink
import mujoco
import numpy as np

from benchmarks.peers.problems.problem import BOX, CAPSULE, Problem

VERSIONS = ("mink", "mujoco", "qpsolvers", "daqp", "numpy")


class Filter:
    """`solve_ik` with limits; `detection` [m]: largest distance of a pair that counts, None for all pairs.

    With `defaults`, gain, clearance and detection distance have the default values of mink.
    """

    margin = 0.0

    def __init__(
        self,
        problem: Problem,
        *,
        broadphase: bool = False,
        detection: float | None = None,
        solver: str = "daqp",
        defaults: bool = False,
        alpha: float | None = None,
        limited: bool = False,
    ) -> None:
        del limited
        self.model = mujoco.MjModel.from_xml_string(mjcf(problem))
        self.dt, self.solver = problem.period, solver
        gain = problem.alpha if alpha is None else alpha
        self.configuration = mink.Configuration(self.model, q=problem.home.copy())
        moving = [f"sphere{i}" for i in np.flatnonzero(problem.sphere_frame > 0)]
        obstacles = [f"obstacle{i}" for i in range(len(problem.kind))]
        options = {
            "gain": gain * self.dt**2,
            "minimum_distance_from_collisions": 0.0,
            "collision_detection_distance": 10.0 if detection is None else detection,
            "broadphase": broadphase,
        }
        self.collision = mink.CollisionAvoidanceLimit(
            self.model, [(moving, obstacles)], **({} if defaults else options)
        )
        speeds = {f"joint{k + 1}": float(problem.v_max[k]) for k in range(problem.n)}
        self.limits = [
            mink.ConfigurationLimit(self.model, gain=problem.alpha * self.dt),
            mink.VelocityLimit(self.model, speeds),
            self.collision,
        ]
        self.task = mink.PostureTask(self.model, cost=1.0)
        self.n_wanted_pairs = problem.n_pairs

    def step(self, q: np.ndarray, u_nom: np.ndarray, v: np.ndarray | None = None) -> np.ndarray:
        """Return the velocity that `solve_ik` computes."""
        del v
        self.configuration.update(q)
        self.task.set_target(q + self.dt * u_nom)
        return mink.solve_ik(self.configuration, [self.task], self.dt, self.solver, limits=self.limits)

    def step_statistics(self) -> dict[str, object]:
        """Return the numbers of pairs and of finite rows of a step."""
        rows = self.collision.compute_qp_inequalities(self.configuration, self.dt)
        near = int(np.count_nonzero(np.isfinite(rows.h)))
        return {"pairs": len(self.collision.geom_id_pairs), "pairs_wanted": self.n_wanted_pairs, "rows_in_qp": near}

    def reported_status(self) -> None:
        """Report no status: failures are exceptions."""

    def reset(self) -> None:
        """Do nothing: the filter has no state."""


def mjcf(problem: Problem) -> str:
    """Return an MJCF model of the chain, its spheres and the obstacles."""
    bodies, ends = "", ""
    for k in range(problem.n):
        bodies += (
            f'<body name="link{k + 1}" pos="{format_numbers(problem.joint_offset[k])}" '
            f'quat="{format_numbers(rotation_to_quaternion(problem.joint_rotation[k]))}">'
            f'<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
            f'<joint name="joint{k + 1}" axis="0 0 1" limited="true" '
            f'range="{float(problem.q_lower[k])!r} {float(problem.q_upper[k])!r}"/>'
        )
        for i in np.flatnonzero(problem.sphere_frame == k + 1):
            bodies += (
                f'<geom name="sphere{i}" type="sphere" size="{float(problem.sphere_radius[i])!r}" '
                f'pos="{format_numbers(problem.sphere_centre[i])}"/>'
            )
        ends += "</body>"
    for i in range(len(problem.kind)):
        ends += (
            f'<body mocap="true" pos="{format_numbers(problem.position[i])}" '
            f'quat="{format_numbers(rotation_to_quaternion(problem.rotation[i]))}"><geom name="obstacle{i}" '
            f"{shape_attributes(problem, i)}/></body>"
        )
    return (
        '<mujoco><compiler angle="radian" autolimits="true"/><option timestep="0.001"/><size memory="64M"/>'
        f"<worldbody>{bodies}{ends}</worldbody></mujoco>"
    )


def shape_attributes(problem: Problem, i: int) -> str:
    """Return type and size of obstacle `i` as MJCF attributes."""
    if problem.kind[i] == CAPSULE:
        return f'type="capsule" size="{float(problem.radius[i])!r} {float(problem.half[i][2])!r}"'
    if problem.kind[i] == BOX:
        return f'type="box" size="{format_numbers(problem.half[i])}"'
    return f'type="sphere" size="{float(problem.radius[i])!r}"'


def rotation_to_quaternion(R: np.ndarray) -> np.ndarray:
    """Return the quaternion (w, x, y, z) of a rotation (3, 3)."""
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(R).ravel())
    return quaternion


def format_numbers(values: np.ndarray) -> str:
    """Format numbers for MJCF."""
    return " ".join(repr(float(value)) for value in values)
