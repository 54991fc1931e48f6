"""Level II of navigation: a long rack leaves two aisles, and somebody is in one of them.

The shorter way leads through the aisle on the shelf's side. Whoever stands there for long, walks up and down, or comes
from the far end leaves no room to pass, so that a contract that takes the wrong aisle waits, is driven back, or gives
up. The person is in the shorter aisle for even seeds, in the other one for odd seeds; what the person does goes round
with the seed. The aisles have names, so that a contract can choose: drive to the aisle first, then on.
"""

from __future__ import annotations

import numpy as np

from dualbrain.records import Box, Place
from dualbrain.world.scene_spec import Mover

RACK, RACK_AT = Box((1.0, 0.7, 0.8)), (2.0, 0.0)
"""Half extents and middle of the rack [m]."""
MIDDLE = 1.4
"""Distance of an aisle's middle from the middle of the room [m]."""
AISLES = (Place("aisle_left", (RACK_AT[0], MIDDLE, 0.0)), Place("aisle_right", (RACK_AT[0], -MIDDLE, 0.0)))


def visitor(rng: np.random.Generator, seed: int, goal_y: float) -> Mover:
    """The person: stays in an aisle, or crosses before or behind the rack, by `seed`; the shelf stands at `goal_y`."""
    shorter = 1.0 if goal_y > 0.0 else -1.0
    side = shorter if seed % 2 == 0 else -shorter
    speed = float(rng.uniform(0.18, 0.28))
    does = ("stays", "before", "behind")[seed % 3]
    if does == "stays":
        x, y, until = float(rng.uniform(1.6, 2.4)), side * MIDDLE, float(rng.uniform(34.0, 60.0))
        return _person((x, y), (-0.7, 1.35 * y), speed, until, 0.0)
    x = float(rng.uniform(0.80, 0.95) if does == "before" else rng.uniform(3.45, 3.60))
    pause = float(rng.uniform(1.0, 3.0))
    return _person((x, 1.8 * side), (x, -1.8 * side), speed, pause, float(rng.uniform(0.0, 20.0)))


def _person(
    start: tuple[float, float], end: tuple[float, float], speed: float, pause: float, phase: float
) -> Mover:  # fmt: skip
    """An upright person who goes from `start` to `end` [m] and back."""
    return Mover(
        (*start, 0.9), (*end, 0.9), speed, pause, phase, name="person", radius=0.25, half_length=0.62,
        axis=(0.0, 0.0, 1.0),
    )  # fmt: skip
