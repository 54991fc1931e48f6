"""Voxels are free, occupied or unknown by what a sensor saw last; hidden voxels keep their state."""

import numpy as np
import pytest

from dualbrain.errors import GeometryError
from dualbrain.safety.integration.point_clouds.occupancy_grid import OccupancyGrid, VoxelState

LOWER, UPPER, VOXEL = (0.0, -0.5, 0.0), (1.0, 0.5, 0.6), 0.05
ORIGIN = np.array([0.5, 0.0, 2.0])


@pytest.fixture
def grid():
    return OccupancyGrid(LOWER, UPPER, VOXEL, memory=5.0)


def state_at(grid, *point):
    return VoxelState(grid.state[grid.index(np.array([point]))[0]])


def test_each_point_is_in_the_voxel_with_the_nearest_centre(grid):
    points = np.random.default_rng(0).uniform(LOWER, UPPER, (200, 3))
    assert grid.contains(points).all()
    assert (np.abs(grid.centres[grid.index(points)] - points) <= 0.5 * VOXEL + 1e-9).all()
    assert not grid.contains(np.array([UPPER, [-0.01, 0.0, 0.1], [np.nan, 0.0, 0.1]])).any()


def test_a_ray_frees_the_voxels_before_its_point_and_none_behind(grid):
    points = np.array([[0.5, 0.0, 0.2]])
    grid.see_through_rays(ORIGIN, points, 0.0)
    grid.mark_occupied(points)
    assert state_at(grid, 0.5, 0.0, 0.2) is VoxelState.OCCUPIED
    assert state_at(grid, 0.5, 0.0, 0.5) is VoxelState.FREE
    assert state_at(grid, 0.5, 0.0, 0.1) is VoxelState.UNKNOWN
    assert state_at(grid, 0.8, 0.0, 0.4) is VoxelState.UNKNOWN


def test_an_obstacle_ends_when_a_sensor_sees_through_it_and_not_when_it_is_hidden(grid):
    hidden = np.array([[0.5, 0.0, 0.2]])
    grid.mark_occupied(hidden)
    above = np.array([[0.5, 0.0, 0.5]])  # something between sensor and obstacle
    grid.see_through_rays(ORIGIN, above, 1.0)
    grid.mark_occupied(above)
    assert state_at(grid, *hidden[0]) is VoxelState.OCCUPIED
    grid.see_through_rays(ORIGIN, np.array([[0.5, 0.0, -0.5]]), 2.0)
    assert state_at(grid, *hidden[0]) is VoxelState.FREE


def test_free_space_is_forgotten_after_the_memory_and_obstacles_never(grid):
    grid.mark_free(grid.index(np.array([[0.5, 0.0, 0.3]])), 1.0)
    grid.mark_occupied(np.array([[0.2, 0.0, 0.3]]))
    grid.forget(6.0)
    assert state_at(grid, 0.5, 0.0, 0.3) is VoxelState.FREE
    grid.forget(6.1)
    assert state_at(grid, 0.5, 0.0, 0.3) is VoxelState.UNKNOWN
    assert state_at(grid, 0.2, 0.0, 0.3) is VoxelState.OCCUPIED


def test_few_points_are_ignored_on_request(grid):
    points = np.array([[0.21, 0.01, 0.31], [0.22, 0.02, 0.32], [0.71, 0.01, 0.31]])
    grid.mark_occupied(points, min_points=2)
    assert np.allclose(grid.occupied(), [[0.225, 0.025, 0.325]])


def test_the_frontier_of_unknown_space_touches_free_space(grid):
    assert len(grid.unknown_frontier()) == 0
    grid.mark_free(grid.index(np.array([[0.525, 0.025, 0.325]])), 0.0)
    steps = np.linalg.norm(grid.unknown_frontier() - [0.525, 0.025, 0.325], axis=1)
    assert len(steps) == 6
    assert np.allclose(steps, VOXEL)


def test_voxels_within_spheres_are_those_of_a_search_over_all(grid):
    rng = np.random.default_rng(1)
    spheres, radii = rng.uniform(-0.3, 1.2, (12, 3)), rng.uniform(0.01, 0.3, 12)
    distance = np.linalg.norm(grid.centres[:, None] - spheres, axis=-1)
    assert np.array_equal(grid.within_spheres(spheres, radii), np.flatnonzero((distance <= radii).any(axis=1)))


@pytest.mark.parametrize(
    ("lower", "upper", "voxel"),
    [(UPPER, LOWER, 0.05), (LOWER, UPPER, 0.0), (LOWER, (9.0, 9.0, 9.0), 0.01), ((np.nan, 0.0, 0.0), UPPER, 0.05)],
    ids=["reversed", "no size", "too many voxels", "NaN"],
)
def test_a_box_that_is_no_grid_is_refused(lower, upper, voxel):
    with pytest.raises(GeometryError):
        OccupancyGrid(lower, upper, voxel)
