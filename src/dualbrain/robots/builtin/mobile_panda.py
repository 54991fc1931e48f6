"""Definition of a Panda on a differential-drive base with a pedestal, which is designed for dualbrain.

The ratio of acceleration to velocity limit of the base is at least that of the Panda (a/v ≥ 3.45 1/s), so that the
gain α of the barriers is that of the Panda alone.
"""

from __future__ import annotations

from itertools import product
from math import sqrt

import msgspec
import numpy as np

from dualbrain.robots.differential_drive import make_differential_base
from dualbrain.robots.mobile_manipulator import mount_arm_on_base
from dualbrain.robots.model import Bound, CollisionSphere, RobotModel, TrackingErrorModel, Vector

LIMITS_SOURCE = "site policy; a platform of dualbrain's own"
HOUSING_BOX: tuple[Vector, Vector] = ((0.0, 0.0, 0.15), (0.28, 0.24, 0.15))
"""Centre and half extents of the housing [m]; its centre is above the axle."""
PEDESTAL_BOX: tuple[Vector, Vector] = ((0.14, 0.0, 0.40), (0.08, 0.08, 0.10))
"""Centre and half extents of the pedestal of the arm [m]."""
ARM_MOUNT_POSITION: Vector = (0.14, 0.0, 0.50)
"""Position of the base of the arm in the frame of the mobile base [m]."""
BOX_CELLS = ((HOUSING_BOX, (4, 3, 2)), (PEDESTAL_BOX, (1, 1, 2)))
"""Number of cells of each box along its axes; one sphere around every cell covers the box."""
RADIUS_MARGIN = 5e-4
"""Margin of a sphere's radius beyond the corners of its cell [m]."""
REST_POSTURE = (0.0, -0.9, 0.0, -2.7, 0.0, 1.8, 0.785)
"""Posture for driving and for the start of a task [rad]: the arm folded over the housing, hand down."""


def make_model(arm: RobotModel, tracking: TrackingErrorModel, base_lag: float | None) -> RobotModel:
    """The model of the Panda `arm` on its mobile base, with the identified tracking error and `base_lag` [s]."""
    return mount_arm_on_base(
        "mobile_panda",
        make_platform(tracking, arm.period),
        arm,
        ARM_MOUNT_POSITION,
        home=(0.0, 0.0, 0.0, *REST_POSTURE),
        tracking=tracking,
        base_lag=base_lag,
        n_samples=20_000,
        rng=np.random.default_rng(0),
    )


def make_platform(tracking: TrackingErrorModel, period: float) -> RobotModel:
    """The model of the mobile base without the arm."""
    bare = make_differential_base(
        "platform",
        (),
        speed=Bound(0.4, "m/s", LIMITS_SOURCE),
        turn_rate=Bound(0.8, "rad/s", LIMITS_SOURCE),
        acceleration=Bound(1.4, "m/s^2", LIMITS_SOURCE),
        turn_acceleration=Bound(3.0, "rad/s^2", LIMITS_SOURCE),
        tracking=tracking,
        period=period,
        source="robots/builtin/mobile_panda.py",
    )
    return msgspec.structs.replace(
        bare, spheres=tuple(sphere for box, cells in BOX_CELLS for sphere in cover_box("base", *box, cells))
    )


def cover_box(
    link: str, centre: Vector, half_extents: Vector, cells: tuple[int, int, int]
) -> tuple[CollisionSphere, ...]:
    """One sphere around every cell of a box; together the spheres cover the box."""
    size = [h / n for h, n in zip(half_extents, cells, strict=True)]
    radius = round(sqrt(sum(s * s for s in size)) + RADIUS_MARGIN, 4)
    found: list[CollisionSphere] = []
    for index in product(*map(range, cells)):
        x, y, z = (
            round(m - h + s * (2 * i + 1), 6) for m, h, s, i in zip(centre, half_extents, size, index, strict=True)
        )
        found.append(CollisionSphere(link, (x, y, z), radius))
    return tuple(found)
