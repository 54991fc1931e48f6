"""cbfpy: barriers in jax.numpy over three kinds of kinematics; QP solved by qpax (relaxed or hard) or elastiqp.

Rows: all pairs, and 14 joint-limit rows (h = q − q_lower, q_upper − q) as in oscbf; |u| ≤ v_max is the control limit.
No certificate, no acceleration limits, no self-collision pairs. Cost: ‖u − u_des‖². The first call traces and
compiles. Single-threaded in float64, as its documentation recommends.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import cbfpy
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.peers.problems.problem import Problem

VERSIONS = ("cbfpy", "jax", "jaxlib", "qpax", "elastiqp", "frax", "oscbf", "numpy")


class Filter:
    """A `cbfpy.CBF`; `kinematics`: "frax", "oscbf" or "plain" (explicit chain); `backend` as in cbfpy."""

    margin = 0.0

    def __init__(
        self,
        problem: Problem,
        *,
        kinematics: str = "plain",
        backend: str = "qpax",
        relax: bool = True,
        tolerance: float | None = None,
        alpha: float | None = None,
        limited: bool = False,
    ) -> None:
        del limited
        sphere_centres, order = KINEMATICS[kinematics](problem)
        options: dict[str, Any] = {"relax_qp": relax}
        if backend != "qpax":
            options["backend"] = backend
        if tolerance is not None:
            options["solver_tol"] = tolerance
        gain = problem.alpha if alpha is None else alpha
        self.cbf = cbfpy.CBF.from_config(make_config(problem, sphere_centres, order, gain, options))
        self.rows = problem.n_pairs + 4 * problem.n

    def step(self, q: np.ndarray, u_nom: np.ndarray, v: np.ndarray | None = None) -> np.ndarray:
        """Return the filtered control as a numpy array, after its computation."""
        del v
        return np.asarray(self.cbf.safety_filter(q, u_nom))

    def step_statistics(self) -> dict[str, object]:
        """Return the number of rows of a step."""
        return {"rows_in_qp": self.rows}

    def reported_status(self) -> None:
        """Report no status: `safety_filter` returns only u."""

    def reset(self) -> None:
        """Do nothing: the filter has no state."""


def make_config(problem: Problem, sphere_centres, order: np.ndarray, gain: float, options: dict[str, Any]):
    """Return a `CBFConfig` for q̇ = u with all barriers of the problem."""
    radius = problem.sphere_radius[order]
    n, q_lower, q_upper = problem.n, problem.q_lower, problem.q_upper

    @jax.tree_util.register_static
    class Arm(cbfpy.CBFConfig):
        def __init__(self) -> None:
            super().__init__(n=n, m=n, u_min=-problem.v_max, u_max=problem.v_max, **options)

        def f(self, z):
            return jnp.zeros(n)

        def g(self, z):
            return jnp.eye(n)

        def h_1(self, z):
            d = distance(problem, sphere_centres(z))
            return jnp.concatenate([(d - radius[:, None]).ravel(), z - q_lower, q_upper - z])

        def alpha(self, h):
            return gain * h

    return Arm()


def distance(problem: Problem, points):
    """Return distances (k, m) from points (k, 3) to every obstacle [m]."""
    offset = points[:, None, :] - problem.position[None]
    if np.any(problem.half != 0.0):
        local = jnp.einsum("mji,kmj->kmi", problem.rotation, offset)
        offset = local - jnp.clip(local, -problem.half, problem.half)
    return jnp.sqrt(jnp.sum(offset * offset, axis=2) + 1e-18) - problem.radius


def plain_kinematics(problem: Problem):
    """Return kinematics written joint by joint with constant transforms."""
    order = np.argsort(problem.sphere_frame[problem.sphere_frame > 0], kind="stable")
    order = np.flatnonzero(problem.sphere_frame > 0)[order]
    by_frame = [problem.sphere_centre[order][problem.sphere_frame[order] == k + 1] for k in range(problem.n)]

    def sphere_centres(q):
        R, p, all_centres = jnp.eye(3), jnp.zeros(3), []
        c, s = jnp.cos(q), jnp.sin(q)
        for k in range(problem.n):
            p = p + R @ problem.joint_offset[k]
            R = R @ problem.joint_rotation[k]
            x, y, z = R[:, 0], R[:, 1], R[:, 2]
            R = jnp.stack([c[k] * x + s[k] * y, c[k] * y - s[k] * x, z], axis=1)
            if len(by_frame[k]):
                all_centres.append(p + by_frame[k] @ R.T)
        return jnp.concatenate(all_centres)

    return sphere_centres, order


def spheres_per_link(problem: Problem) -> tuple[tuple, tuple, np.ndarray]:
    """Return sphere positions and radii by link, and their order in the problem."""
    groups = [np.flatnonzero(problem.sphere_frame == k + 1) for k in range(problem.n)]
    positions = tuple(tuple(tuple(map(float, problem.sphere_centre[i])) for i in group) for group in groups)
    radii = tuple(tuple(float(problem.sphere_radius[i]) for i in group) for group in groups)
    return positions, radii, np.concatenate(groups)


def frax_kinematics(problem: Problem):
    """Return the kinematics of a frax manipulator from a URDF of the chain, with the spheres of the problem."""
    from frax.core.manipulator import Manipulator  # noqa: PLC0415

    positions, radii, order = spheres_per_link(problem)
    data = {
        "positions": positions,
        "radii": radii,
        "root_positions": (),
        "root_radii": (),
        "root_sc_pairs": (),
        "root_sc_tols": (),
        "body_sc_pairs": (),
        "body_sc_tols": (),
    }
    robot = Manipulator(str(write_urdf(problem)), collision_data=data)
    return lambda q: robot.link_collision_data(q)[0], order


def oscbf_kinematics(problem: Problem):
    """Return the kinematics of an oscbf manipulator from the same URDF, with the spheres of the problem."""
    from oscbf.core.manipulator import Manipulator  # noqa: PLC0415

    positions, radii, order = spheres_per_link(problem)
    robot = Manipulator.from_urdf(
        str(write_urdf(problem)), ee_offset=np.eye(4), collision_data={"positions": positions, "radii": radii}
    )
    return lambda q: robot.link_collision_data(q)[:, :3], order


KINEMATICS = {"plain": plain_kinematics, "frax": frax_kinematics, "oscbf": oscbf_kinematics}


def write_urdf(problem: Problem) -> Path:
    """Write a URDF of the chain, with unit inertias (kinematics does not use them)."""
    inertia = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    parts = [f'<link name="link{k}">{inertia}</link>' for k in range(problem.n + 1)]
    for k in range(problem.n):
        xyz = " ".join(repr(float(x)) for x in problem.joint_offset[k])
        rpy = " ".join(repr(float(x)) for x in roll_pitch_yaw(problem.joint_rotation[k]))
        limits = f'lower="{problem.q_lower[k]}" upper="{problem.q_upper[k]}" velocity="{problem.v_max[k]}" effort="87"'
        parts.append(
            f'<joint name="joint{k + 1}" type="revolute"><parent link="link{k}"/><child link="link{k + 1}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 0 1"/><limit {limits}/></joint>'
        )
    path = Path(tempfile.mkdtemp()) / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(parts)}</robot>')
    return path


def roll_pitch_yaw(R: np.ndarray) -> tuple[float, float, float]:
    """Return the fixed-axis angles [rad] of a rotation (3, 3), R = Rz(yaw) Ry(pitch) Rx(roll)."""
    return (
        float(np.arctan2(R[2, 1], R[2, 2])),
        float(np.arcsin(np.clip(-R[2, 0], -1.0, 1.0))),
        float(np.arctan2(R[1, 0], R[0, 0])),
    )
