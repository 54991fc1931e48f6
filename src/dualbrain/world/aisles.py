"""Level II of navigation: a long rack leaves two aisles; parcels make one narrow, somebody may stand in the other.

Driving between parcels costs intervention, which a contract avoids by taking the other aisle. Somebody who stays in an
aisle lets nobody pass: for a while, so that waiting is the gentler way, or for longer than a skill waits.
What there is goes round with the seed; the aisles have names, so that a contract can choose: drive to the aisle first,
then on.
"""

from __future__ import annotations

import numpy as np

from dualbrain.records import Box, Place
from dualbrain.world.scene_spec import Mover, Thing

RACK, RACK_AT = Box((1.0, 0.35, 0.8)), (2.0, 0.0)
"""Half extents and middle of the rack [m]."""
MIDDLE = 1.28
"""Distance of an aisle's middle from the middle of the room [m]."""
AISLES = (Place("aisle_left", (RACK_AT[0], MIDDLE, 0.0)), Place("aisle_right", (RACK_AT[0], -MIDDLE, 0.0)))
GAP, ASIDE = (0.75, 0.79), 0.08
"""Width of the way between two parcels, and how far it lies off the aisle's middle, to one side and then to the other
[m]; a circle around the base is 0.61 m wide."""


def hazards(rng: np.random.Generator, seed: int, goal_y: float) -> tuple[list[Thing], Mover]:
    """Parcels and person for `seed`, where the shelf stands at y = `goal_y` [m] and so makes one aisle the shorter.

    In turn: a person stays in the shorter aisle for longer than a skill waits, and the other is narrow; the shorter is
    narrow and the other free; the shorter is narrow and a person stays in the other for a while.
    """
    shorter = 1.0 if goal_y > 0.0 else -1.0
    narrow = -shorter if seed % 3 == 0 else shorter
    parcels = _parcels(rng, narrow)
    middle = (float(rng.uniform(1.6, 2.4)), -narrow * MIDDLE)
    until = ((100.0, 130.0), (90.0, 120.0), (10.0, 18.0))[seed % 3]
    start = (-0.3, -1.95 * narrow) if seed % 3 == 1 else middle
    return parcels, _person(start, (-0.7, -1.9 * narrow), float(rng.uniform(0.35, 0.50)), float(rng.uniform(*until)))


def _parcels(rng: np.random.Generator, side: float) -> list[Thing]:
    """Two pairs of parcels in the aisle on `side` (1 left, -1 right), each with a gap, so that the way bends."""
    found: list[Thing] = []
    bend = 1.0 if rng.random() < 0.5 else -1.0
    for colour, x, shift in (("brown", 1.40, bend), ("white", 2.60, -bend)):
        gap, centre = float(rng.uniform(*GAP)), side * MIDDLE + shift * ASIDE
        for number, way in enumerate((1.0, -1.0), start=1):
            half = float(rng.uniform(0.12, 0.15))
            at = (x + float(rng.uniform(-0.05, 0.05)), centre + way * (gap / 2 + half), half)
            name = f"{colour}_parcel_{number}"
            found.append(Thing(name, "object", Box((half, half, half)), at, 4.0, colour, "parcel"))
    return found


def _person(start: tuple[float, float], end: tuple[float, float], speed: float, until: float) -> Mover:
    """An upright person who stands at `start` [m] until time `until` [s], then goes to `end` and back."""
    return Mover(
        (*start, 0.9), (*end, 0.9), speed, until, 0.0, name="person", radius=0.25, half_length=0.62,
        axis=(0.0, 0.0, 1.0),
    )  # fmt: skip
