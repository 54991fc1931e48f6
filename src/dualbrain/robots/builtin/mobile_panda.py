"""The facts of a Panda on a carrier of dualbrain's own: a differential base with a pedestal.

Its acceleration limits are as steep, against its speeds, as the Panda's own (a/v ≥ 3.45 1/s), so that the gain α of the
barriers is that of the Panda alone.
"""

from __future__ import annotations

from itertools import product
from math import sqrt

import msgspec
import numpy as np

from dualbrain.robots.differential_drive import differential_base
from dualbrain.robots.mobile_manipulator import on_base
from dualbrain.robots.model import Body, BodySphere, Bound, Tracking, Vector

POLICY = "site policy; a platform of dualbrain's own"
HOUSING: tuple[Vector, Vector] = ((0.0, 0.0, 0.15), (0.28, 0.24, 0.15))
"""Middle and half extents of the housing [m], the axle under its middle."""
PEDESTAL: tuple[Vector, Vector] = ((0.14, 0.0, 0.40), (0.08, 0.08, 0.10))
"""Middle and half extents of what the arm stands on [m]."""
MOUNT: Vector = (0.14, 0.0, 0.50)
"""Where the arm's base is bolted [m]."""
CELLS = ((HOUSING, (4, 3, 2)), (PEDESTAL, (1, 1, 2)))
"""Into how many cells each box is cut; one ball around every cell covers it whole."""
SPARE = 5e-4
"""How much larger than its cell a ball is [m]."""
REST = (0.0, -0.9, 0.0, -2.7, 0.0, 1.8, 0.785)
"""The arm drawn in over the housing, hand down: for driving, and to begin work from."""


def body(arm: Body, tracking: Tracking, base_lag: float | None) -> Body:
    """The Panda `arm` on its carrier, with what was identified on the plant."""
    return on_base(
        "mobile_panda", platform(tracking, arm.period), arm, MOUNT, home=(0.0, 0.0, 0.0, *REST), tracking=tracking,
        base_lag=base_lag, count=20_000, rng=np.random.default_rng(0),
    )  # fmt: skip


def platform(tracking: Tracking, period: float) -> Body:
    """The carrier without its arm."""
    bare = differential_base(
        "platform", (), speed=Bound(0.4, "m/s", POLICY), turn=Bound(0.8, "rad/s", POLICY),
        acceleration=Bound(1.4, "m/s^2", POLICY), turn_acceleration=Bound(3.0, "rad/s^2", POLICY), tracking=tracking,
        period=period, source="robots/builtin/mobile_panda.py",
    )  # fmt: skip
    return msgspec.structs.replace(
        bare, spheres=tuple(ball for box, cells in CELLS for ball in balls("base", *box, cells))
    )


def balls(link: str, middle: Vector, half: Vector, cells: tuple[int, int, int]) -> tuple[BodySphere, ...]:
    """One ball around every cell of a box: together they hold it whole."""
    size = [h / n for h, n in zip(half, cells, strict=True)]
    radius = round(sqrt(sum(s * s for s in size)) + SPARE, 4)
    found: list[BodySphere] = []
    for index in product(*map(range, cells)):
        x, y, z = (round(m - h + s * (2 * i + 1), 6) for m, h, s, i in zip(middle, half, size, index, strict=True))
        found.append(BodySphere(link, (x, y, z), radius))
    return tuple(found)
