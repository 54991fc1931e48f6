"""traversable: the footprint of a mobile base stays inside a convex region of the floor."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from dualbrain.core.geometry.validation import MAX_COORDINATE, check_array, check_sequence
from dualbrain.errors import ConfigurationError, GeometryError
from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.keep_out import scenario_base
from dualbrain.safety.barriers.scenarios import EXACT_TRACKING
from dualbrain.safety.barriers.workspace import plane
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.rows import Rank

MAX_CORNERS = 100
"""Most corners of a region."""
REGION = ((-1.0, -0.8), (1.5, -0.8), (1.9, 0.3), (0.4, 1.2), (-1.0, 0.8))


def traversable_region(name: str, corners: Sequence[tuple[float, float]]) -> tuple[Obstacle, ...]:
    """Obstacles that keep the base inside a convex polygon, one half-space for each edge.

    `corners` are (x, y) [m], counter-clockwise. Raises `ConfigurationError` if the polygon is not convex or not
    counter-clockwise, and its `GeometryError` for corners that are not usable.
    """
    found = check_sequence(f"corners of {name!r}", corners, MAX_CORNERS, of="corners")
    corners = [check_array(f"corner of {name!r}", corner, (2,), MAX_COORDINATE).tolist() for corner in found]
    if len(corners) < 3:
        raise GeometryError(f"corners of {name!r}", got=corners, allowed="three corners or more")
    walls: list[Obstacle] = []
    for index, (x, y) in enumerate(corners):
        to_x, to_y = corners[(index + 1) % len(corners)]
        after_x, after_y = corners[(index + 2) % len(corners)]
        along = (to_x - x, to_y - y)
        if not along[0] * (after_y - to_y) - along[1] * (after_x - to_x) > 0.0:
            raise ConfigurationError(
                f"corners of {name!r}", got=list(corners), allowed="a convex polygon, counter-clockwise"
            )
        walls.append(plane(f"{name} edge {index}", (x, y, 0.0), (-along[1], along[0], 0.0), parts=()))
    return tuple(msgspec.structs.replace(wall, barrier="traversable") for wall in walls)


def _scenario() -> Scenario:
    safety = SafetyFilter(scenario_base(), EXACT_TRACKING)
    safety.observe(traversable_region("hall", REGION))
    corners = np.array(REGION)
    along = np.roll(corners, -1, axis=0) - corners
    inward = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]

    def h(q: Array, u: Array) -> float:
        del u
        centres, radii, _ = safety.spheres(q, 0.0)
        distance = np.einsum("ek,sek->se", inward, centres[:, None, :2] - corners[None])
        return float(np.min(distance - radii[:, None]))

    return Scenario(
        safety=safety, start=np.array([0.0, 0.0, 0.5]), nominal=lambda q: np.array([0.8, 0.1]), h=h, duration=8.0
    )


BARRIER = BarrierSpec(
    name="traversable",
    description="every disc of a base's footprint stays inside a convex region of the floor",
    h="h = n_e'(p_i − c_e) − r_i for every edge e",
    row="n_e'J_i u ≥ −s(h) + …, as for obstacles",
    rank=Rank.WORKSPACE,
    alpha="FilterConfig.alpha",
    margins=("sampling", "tracking", "measurement", "rounding"),
    source="paper 4.2: traversable regions",
    implementation="safety/barriers/traversable_region.py onto kernel/src/rows/dbk_obstacle_rows.c",
    scenario=_scenario,
)
