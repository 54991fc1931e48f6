"""cartesian_speed: no part of the robot is faster than a limit, also while it evades a person or stops."""

from __future__ import annotations

import msgspec
import numpy as np

from dualbrain.safety.barriers.barrier import Array, BarrierSpec, Scenario
from dualbrain.safety.barriers.scenarios import (
    EXACT_TRACKING,
    home_posture,
    moving_spheres,
    sparse_panda_filter,
    tool_push,
)

LIMIT = 0.2


def _scenario() -> Scenario:
    safety = sparse_panda_filter(msgspec.structs.replace(EXACT_TRACKING, cartesian_speed=LIMIT))

    def points(q: Array) -> Array:
        return np.vstack([moving_spheres(safety, q)[0], safety.tool(q).position])

    def h(q: Array, u: Array) -> float:
        """Limit minus the largest speed of a part, from central differences; float32 centres resolve 1e-3 m/s."""
        step = 1e-3
        speeds = np.linalg.norm(points(q + step * u) - points(q - step * u), axis=1) / (2.0 * step)
        return float(LIMIT - speeds.max() + 1e-3)

    return Scenario(safety=safety, start=home_posture(safety), nominal=tool_push(safety, (0.0, 1.0, 0.0), 0.6), h=h)


BARRIER = BarrierSpec(
    name="cartesian_speed",
    description="the tool and the centre of every sphere, also of a grasped object, keep the speed limit; near a "
    "person with power and force limiting the limit is the contact speed of the body region",
    h="h = v_max − |J_p u|, least over the points p",
    row="−n'J_p u ≥ −v_max for directions n of too fast points, until no point is too fast: an exact cone up to 0.1 %",
    rank=None,
    alpha="none: the speed depends directly on the control; what it grows in four periods is reserved; if "
    "no control has this reserve, the limit itself is tried, then the least part of the excess of braking",
    margins=("sampling", "rounding"),
    source="FilterConfig.cartesian_speed, tool_speed of the robot model or site file; formula of power and force "
    "limiting in ISO/TS 15066, not a certified function",
    implementation="kernel/src/speed/dbk_speed_limit.c, kernel/src/speed/dbk_speed_braking.c",
    scenario=_scenario,
)
