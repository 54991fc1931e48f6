"""dualbrain: `SafetyFilter` called from Python with its certificate, and the same step timed in C.

On the thin arm: cost ‖u − u_nom‖² without acceleration limits and tracking error, because no peer has them; margins,
sampling term, joint limits, the independent check of u and the certificate are on. On the whole arm: the defaults.
"""

from __future__ import annotations

import numpy as np

from benchmarks.peers.problems.problem import BOX, CAPSULE, Problem
from benchmarks.peers.problems.scenes import thin_body
from dualbrain.core.geometry.shapes import Box, Capsule, Pose, Sphere
from dualbrain.errors import ConfigurationError
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.compiled import _kernel
from dualbrain.safety.cbf.filter import FilterConfig, Obstacle, SafetyFilter

VERSIONS = ("dualbrain", "numpy")


class Filter:
    """`SafetyFilter` on a problem; `how`: "call" (with arrays), "state" (with a RobotState) or "c" (loop in C).

    Raises `ConfigurationError` if the problem has more obstacles than the kernel allows.
    """

    def __init__(self, problem: Problem, *, how: str = "call", limited: bool = False) -> None:
        if len(problem.kind) > _kernel.max_obstacles:
            raise ConfigurationError("obstacles", got=len(problem.kind), allowed=f"at most {_kernel.max_obstacles}")
        robot_model = load_robot("panda") if problem.whole_body else thin_body()
        config = FilterConfig(
            lag_compensation=problem.whole_body,
            tracking_error=None if problem.whole_body else 0.0,
            acceleration_limits=problem.whole_body or limited,
        )
        self.margin = config.sampling_margin + config.rounding_margin
        self.filter = SafetyFilter(robot_model, config, weight=None if problem.whole_body else np.eye(robot_model.n))
        self.filter.observe([_obstacle(problem, i) for i in range(len(problem.kind))])
        self._zero_velocity, self.opening, self.last_result = np.zeros(problem.n), 0.0, None
        self.call_mode = how

    def step(self, q: np.ndarray, u_nom: np.ndarray, v: np.ndarray | None = None) -> np.ndarray:
        """Return the control at q [rad] and v [rad/s] (zero if None) for the nominal control [rad/s]; all (n,)."""
        self.last_result = result = self.filter(q, self._zero_velocity if v is None else v, u_nom)
        return result.u

    def block(self, states: np.ndarray, nominals: np.ndarray, clock) -> list[int]:
        """Return the times of the calls of a block [ns], or their mean in C."""
        if self.call_mode == "c":
            mean = self.filter._kernel.time_steps(np.ascontiguousarray(states), np.ascontiguousarray(nominals), False)
            return [round(1e9 * mean)]
        times: list[int] = []
        if self.call_mode == "state":
            prepared = [
                RobotState(stamp=0.0, sequence=k, q=q, v=self._zero_velocity, opening=0.0, finger_forces=(0.0, 0.0))
                for k, q in enumerate(states)
            ]
            filtered = self.filter.filter
            for state, u_nom in zip(prepared, nominals, strict=True):
                start = clock()
                filtered(state, u_nom, 0.0)
                times.append(clock() - start)
            return times
        safety, v = self.filter, self._zero_velocity
        for q, u_nom in zip(states, nominals, strict=True):
            start = clock()
            safety(q, v, u_nom)
            times.append(clock() - start)
        return times

    def step_statistics(self) -> dict[str, object]:
        """Return the number of QP rows and the certificate of the last step."""
        if self.last_result is None:
            return {}
        return {"rows_in_qp": self.last_result.n_rows, "certified": self.last_result.certified}

    def stated_rows(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return A, b, lower and upper of the last step, as stated by the filter."""
        rows = self.filter.rows()
        lower, upper = self.filter._kernel.box()
        A = np.array([row.a for row in rows], float).reshape(len(rows), len(lower))
        return A, np.array([row.b for row in rows], float), np.array(lower), np.array(upper)

    def reported_status(self) -> str | None:
        """Return status and reason of the last result, None before the first step."""
        if self.last_result is None:
            return None
        reason = self.last_result.reason.name
        return self.last_result.status.name + (
            f" ({reason.lower().replace('|', ', ').replace('_', ' ')})" if reason else ""
        )

    def reset(self) -> None:
        """Reset the state of the filter."""
        self.filter.reset()


def _obstacle(problem: Problem, i: int) -> Obstacle:
    x, y, z = problem.position[i].tolist()
    a, b, c = problem.half[i].tolist()
    shape = Sphere(float(problem.radius[i]))
    if problem.kind[i] == CAPSULE:
        shape = Capsule(radius=float(problem.radius[i]), half_length=c)
    if problem.kind[i] == BOX:
        shape = Box((a, b, c))
    return Obstacle(f"o{i}", shape, Pose((x, y, z), quaternion(problem.rotation[i])))


def quaternion(R: np.ndarray) -> tuple[float, float, float, float]:
    """Return the quaternion (w, x, y, z) of a rotation (3, 3) by the method of Bar-Itzhack.

    It is the eigenvector of the largest eigenvalue of his matrix K.
    """
    K = np.array(
        [
            [R[0, 0] + R[1, 1] + R[2, 2], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]],
            [R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]],
            [R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], R[2, 2] - R[0, 0] - R[1, 1]],
        ]
    )
    w, x, y, z = np.linalg.eigh(K)[1][:, -1].tolist()
    return w, x, y, z
