"""self_collision: the links of the robot keep away from each other."""

from __future__ import annotations

import numpy as np

from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import home_posture, sparse_panda_filter
from dualbrain.safety.cbf.rows import Rank

FOLDED_POSTURE = np.array([-0.64, 1.66, -0.08, -2.82, 0.5, 1.17, 0.84])
"""A posture in which the hand penetrates the arm [rad]."""


def _scenario() -> Scenario:
    safety = sparse_panda_filter()
    robot_model = safety.robot_model
    links = [link.name for link in robot_model.links for sphere in robot_model.spheres if sphere.link == link.name]
    kept = {frozenset(pair) for pair in robot_model.self_pairs.kept}
    pairs = [(i, j) for i in range(len(links)) for j in range(i) if frozenset((links[i], links[j])) in kept]
    first, second = np.array(pairs).T

    def h(q: Array, u: Array) -> float:
        del u
        centres, radii, _ = safety.spheres(q, 0.0)
        distance = np.linalg.norm(centres[first] - centres[second], axis=1)
        return float(np.min(distance - radii[first] - radii[second]))

    return Scenario(
        safety=safety, start=home_posture(safety), nominal=lambda q: 2.0 * (FOLDED_POSTURE - q), h=h, duration=3.0
    )


BARRIER = BarrierSpec(
    name="self_collision",
    description="the links of the robot keep apart, for every pair of links that may not touch by construction",
    h="h = |c_i − c_j| − r_i − r_j − margins",
    row="n'(J_i − J_j) u ≥ −s(h) + tracking Σ|n'J_k| + Δt/2 C",
    rank=Rank.BODY,
    alpha="FilterConfig.alpha_self, or FilterConfig.alpha if that is None",
    margins=("sampling", "tracking", "rounding"),
    source="paper 4.2; pairs and their reasons: RobotModel.self_pairs",
    implementation="kernel/src/rows/dbk_self_collision_rows.c",
    scenario=_scenario,
)
