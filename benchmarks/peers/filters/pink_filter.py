"""pink: `SelfCollisionBarrier` between the arm's spheres and the obstacles, solved by DAQP through `solve_ik`.

Rows: all pairs by coal, built one by one in Python; `closest` keeps only the nearest ones. Joint and velocity limits
are those of pink. Gain: ∂h/∂q q̇ ≥ −gain h, so gain = α; the gain of the joint limits counts per step, so α dt. The
nominal control enters as a posture target q + u_nom dt (JointVelocityTask of 4.4.0 tracks the negative of its target).
The cost of the safe displacement is off, because it would change u in states without an active row.
"""

from __future__ import annotations

import coal
import numpy as np
import pink
import pinocchio as pin
from pink.barriers import SelfCollisionBarrier
from pink.limits import ConfigurationLimit, VelocityLimit
from pink.tasks import PostureTask

from benchmarks.peers.problems.problem import BOX, CAPSULE, Problem

VERSIONS = ("pin-pink", "pin", "coal", "qpsolvers", "daqp", "numpy")
NO_DAMPING = 1e-12


class Filter:
    """`solve_ik` with barriers on a pinocchio model of the arm."""

    margin = 0.0

    def __init__(
        self,
        problem: Problem,
        *,
        closest: int | None = None,
        solver: str = "daqp",
        alpha: float | None = None,
        limited: bool = False,
    ) -> None:
        del limited
        model, geometry = build_arm(problem)
        gain = problem.alpha if alpha is None else alpha
        self.dt, self.solver = problem.period, solver
        self.configuration = pink.Configuration(
            model,
            model.createData(),
            problem.home.copy(),
            collision_model=geometry,
            collision_data=geometry.createData(),
        )
        self.n_pairs_in_qp = problem.n_pairs if closest is None else min(closest, problem.n_pairs)
        self.barriers = [SelfCollisionBarrier(self.n_pairs_in_qp, gain=gain, safe_displacement_gain=0.0, d_min=0.0)]
        self.limits = [ConfigurationLimit(model, config_limit_gain=problem.alpha * self.dt), VelocityLimit(model)]
        self.task = PostureTask(cost=1.0)
        self.n_pairs = problem.n_pairs

    def step(self, q: np.ndarray, u_nom: np.ndarray, v: np.ndarray | None = None) -> np.ndarray:
        """Return the velocity that `solve_ik` computes."""
        del v
        self.configuration.update(q)
        self.task.set_target(q + self.dt * u_nom)
        return pink.solve_ik(
            self.configuration,
            [self.task],
            self.dt,
            solver=self.solver,
            damping=NO_DAMPING,
            limits=self.limits,
            barriers=self.barriers,
        )

    def step_statistics(self) -> dict[str, object]:
        """Return the numbers of pairs and rows of a step."""
        return {"pairs": self.n_pairs, "rows_in_qp": self.n_pairs_in_qp + 4 * len(self.configuration.q)}

    def reported_status(self) -> None:
        """Report no status: failures are exceptions."""

    def reset(self) -> None:
        """Do nothing: the filter has no state."""


def build_arm(problem: Problem) -> tuple[pin.Model, pin.GeometryModel]:
    """Return models of the chain and of all geometries, with a collision pair per moving sphere and obstacle."""
    model = pin.Model()
    parent = 0
    for k in range(problem.n):
        placement = pin.SE3(problem.joint_rotation[k], problem.joint_offset[k])
        parent = model.addJoint(
            parent,
            pin.JointModelRZ(),
            placement,
            f"joint{k + 1}",
            np.array([87.0]),
            problem.v_max[k : k + 1],
            problem.q_lower[k : k + 1],
            problem.q_upper[k : k + 1],
        )
    geometry = pin.GeometryModel()
    spheres = [
        geometry.addGeometryObject(
            pin.GeometryObject(
                f"sphere{i}",
                int(problem.sphere_frame[i]),
                0,
                pin.SE3(np.eye(3), problem.sphere_centre[i]),
                coal.Sphere(float(problem.sphere_radius[i])),
            )
        )
        for i in np.flatnonzero(problem.sphere_frame > 0)
    ]
    for i in range(len(problem.kind)):
        placement = pin.SE3(problem.rotation[i], problem.position[i])
        obstacle = geometry.addGeometryObject(
            pin.GeometryObject(f"obstacle{i}", 0, 0, placement, collision_shape(problem, i))
        )
        for sphere in spheres:
            geometry.addCollisionPair(pin.CollisionPair(sphere, obstacle))
    return model, geometry


def collision_shape(problem: Problem, i: int) -> coal.CollisionGeometry:
    """Return obstacle `i` as a coal geometry; all three kinds are exact."""
    radius, half = float(problem.radius[i]), problem.half[i]
    if problem.kind[i] == CAPSULE:
        return coal.Capsule(radius, 2.0 * float(half[2]))
    if problem.kind[i] == BOX:
        return coal.Box(*(2.0 * half))
    return coal.Sphere(radius)
