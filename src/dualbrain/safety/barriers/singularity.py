"""singularity: the arm slows down near singular postures without stopping."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dualbrain.robots.interface import RobotState
from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import sparse_panda_filter
from dualbrain.safety.cbf.rows import ConstraintRow, Rank

SINGULAR_POSTURE = np.array([0.0, 0.0, np.pi / 2, -1.2, 0.0, 1.2, 0.0])
"""A singular posture [rad]: the axes of the first and third joint and the elbow leave one direction unreachable."""


class SingularityBarrier:
    """h = σ − floor, with σ the smallest singular value of the tool Jacobian whose angular rows are scaled by `length`.

    The row σ̇ = ∇σ'u ≥ −max(α h, min_rate) lets σ fall ever more slowly down to `floor`, and from there on at
    `min_rate` [m/(rad s)], so that a path through a singular posture is slowed down and never blocked.
    """

    def __init__(self, alpha: float, floor: float = 0.03, min_rate: float = 0.02, length: float = 0.3) -> None:
        """`alpha` [1/s] should be `RobotModel.alpha`, `length` is in m. Rows do not bind above floor + σ̇_max/α."""
        self.alpha, self.floor, self.min_rate, self.length = alpha, floor, min_rate, length

    def rows(self, state: RobotState, jacobian: Array) -> Sequence[ConstraintRow]:
        """The row at this state, or no row where the gradient of σ vanishes."""
        del state
        sigma, gradient = min_singular_value(jacobian, self.length)
        h = sigma - self.floor
        size = float(np.linalg.norm(gradient))
        if size < 1e-6:
            return ()
        return (
            ConstraintRow(
                name="singularity",
                a=tuple(gradient.tolist()),
                b=-max(self.alpha * h, self.min_rate),
                h=h,
                rank=Rank.TASK,
            ),
        )


def min_singular_value(jacobian: Array, length: float) -> tuple[float, Array]:
    """σ_min of the scaled Jacobian (6, n) and its gradient ∂σ/∂q_k = w'(∂J/∂q_k) v (n,), w and v its singular vectors.

    With columns (l_j, ω_j): ∂l_j/∂q_k = ω_k × l_j and ∂ω_j/∂q_k = ω_k × ω_j for j ≥ k, ∂l_j/∂q_k = ω_j × l_k for j < k,
    so that sums over j become running sums.
    """
    scale = np.array([1.0, 1.0, 1.0, length, length, length])
    left, values, right = np.linalg.svd(scale[:, None] * jacobian)
    w, v = scale * left[:, -1], right[len(values) - 1]
    linear, angular = jacobian[:3].T, jacobian[3:].T
    along, about = v[:, None] * linear, v[:, None] * angular
    later = np.cumsum(along[::-1], axis=0)[::-1]
    turning = np.cumsum(about[::-1], axis=0)[::-1]
    earlier = np.cumsum(about, axis=0) - about
    moved = np.cross(angular, later) + np.cross(earlier, linear)
    return float(values[-1]), moved @ w[:3] + np.cross(angular, turning) @ w[3:]


def _scenario() -> Scenario:
    robot_model = sparse_panda_filter().robot_model
    barrier = SingularityBarrier(robot_model.alpha)
    safety = sparse_panda_filter(barriers=(barrier,))
    start = np.array([0.3, 0.5, 0.4, -1.2, 0.3, 1.2, 0.0])

    def h(q: Array, u: Array) -> float:
        """σ̇ minus the least σ̇ that the barrier allows at q."""
        sigma, gradient = min_singular_value(safety.tool(q).jacobian, barrier.length)
        return float(gradient @ u + max(robot_model.alpha * (sigma - barrier.floor), barrier.min_rate) + 2e-3)

    return Scenario(safety=safety, start=start, nominal=lambda q: 1.5 * (SINGULAR_POSTURE - q), h=h, duration=3.0)


BARRIER = BarrierSpec(
    name="singularity",
    description="the arm slows down near singular postures and passes through them slowly; it is never stopped there",
    h="h = σ_min(J) − floor",
    row="∇σ'u ≥ −max(α h, min_rate)",
    rank=Rank.TASK,
    alpha="SingularityBarrier.alpha",
    margins=(),
    source="design: slow down, do not stop; gradient of a singular value: w'(∂J/∂q) v",
    implementation="safety/barriers/singularity.py, a PythonBarrier",
    scenario=_scenario,
)
