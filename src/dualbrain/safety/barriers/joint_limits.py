"""joint_limits: every joint stays in its position range and can always brake before the limit."""

from __future__ import annotations

import numpy as np

from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import home_posture, sparse_panda_filter


def _scenario() -> Scenario:
    safety = sparse_panda_filter()
    lower, upper = (
        np.array([getattr(joint, side).value for joint in safety.robot_model.joints]) for side in ("lower", "upper")
    )
    push = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.6])

    def h(q: Array, u: Array) -> float:
        del u
        return float(np.min(np.minimum(q - lower, upper - q)))

    return Scenario(safety=safety, start=home_posture(safety), nominal=lambda q: push, h=h)


BARRIER = BarrierSpec(
    name="joint_limits",
    description="every joint stays in its position range and can brake before the limit at its own deceleration",
    h="h = q_max − q and q − q_min",
    row="u ≤ min(α h, v_b(h)) − tracking, v_b(h) = −a Δt/2 + √((a Δt/2)² + 2 a h); with jerk limits "
    "u ≤ α h − tracking also in every period of a stop with the maximum jerk",
    rank=None,
    alpha="FilterConfig.alpha_joint, or FilterConfig.alpha if that is None",
    margins=("tracking", "rounding"),
    source="paper 4.2; discrete braking: Del Prete, RA-L 2018",
    implementation="kernel/src/model/dbk_control_bounds.c",
    scenario=_scenario,
)
