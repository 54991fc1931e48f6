"""The boxes contain every voxel, are as many as allowed, and state the clearance that they take."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dualbrain.safety.integration.point_clouds.box_cover import box_distances, cover_voxels

VOXEL = 0.02
CELLS = hnp.arrays(np.int64, st.tuples(st.integers(1, 60), st.just(3)), elements=st.integers(-30, 30))
RADII = np.array([0.05, 0.1, 0.02])


def brute_force_distance(low, high, sphere, radius):
    """Distance of one sphere from one box by its nearest point."""
    return float(np.linalg.norm(np.clip(sphere, low, high) - sphere) - radius)


@settings(max_examples=60)
@given(CELLS, st.integers(1, 20), st.integers(0, 2**32 - 1))
def test_every_voxel_is_in_a_box_and_the_lost_clearance_is_true(cells, limit, seed):
    centres = (np.unique(cells, axis=0) + 0.5) * VOXEL
    spheres = np.random.default_rng(seed).uniform(-0.8, 0.8, (3, 3))
    cover = cover_voxels(centres, VOXEL, spheres, RADII, limit=limit)
    low, high = centres - 0.5 * VOXEL, centres + 0.5 * VOXEL
    inside = np.all(cover.low[None] <= low[:, None] + 1e-12, axis=-1) & np.all(
        high[:, None] <= cover.high[None] + 1e-12, axis=-1
    )
    assert inside.any(axis=1).all()
    assert len(cover.low) <= min(limit, len(centres))
    of = [
        min(brute_force_distance(a, b, sphere, radius) for a, b in zip(lows, highs, strict=True))
        for lows, highs in ((low, high), (cover.low, cover.high))
        for sphere, radius in zip(spheres, RADII, strict=True)
    ]
    assert cover.clearance == pytest.approx(min(of[:3]))
    assert cover.lost == pytest.approx(max(true - boxes for true, boxes in zip(of[:3], of[3:], strict=True)))


def test_more_boxes_cost_less_and_enough_of_them_cost_nothing():
    cells = np.array([[x, y, 0] for x in range(12) for y in range(12) if (x - 6) ** 2 + (y - 6) ** 2 >= 25])
    centres, sphere = cells * VOXEL, np.array([[0.12, 0.12, 0.0]])
    lost = [cover_voxels(centres, VOXEL, sphere, np.array([0.03]), limit=n).lost for n in (1, 4, 200)]
    assert lost[0] > lost[1] >= lost[2] == 0.0


def test_the_boxes_near_the_robot_are_smaller():
    rng = np.random.default_rng(3)
    cells = np.unique(rng.integers(-40, 40, (1500, 3)), axis=0)
    spheres = np.array([[0.9, 0.0, 0.0]])
    cover = cover_voxels(cells * VOXEL, VOXEL, spheres, np.array([0.05]), limit=40)
    distance = box_distances(cover.low, cover.high, spheres, np.array([0.05]))[:, 0]
    size = np.linalg.norm(cover.high - cover.low, axis=1)
    near = distance < np.median(distance)
    assert size[near].mean() < 0.75 * size[~near].mean()


def test_no_voxel_needs_no_box():
    cover = cover_voxels(np.zeros((0, 3)), VOXEL, np.zeros((1, 3)), np.ones(1), limit=3)
    assert len(cover.low) == 0
    assert cover.clearance == np.inf
