"""Primitive fitting: sampled shapes are recovered at any position and yaw."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.geometry.shapes import Bowl, Cylinder
from dualbrain.simulation.perception.primitive_fitting import (
    COLOUR_GAIN,
    COLOUR_OFFSET,
    OBJECT_COLOURS,
    fit_primitives,
    nearest_colour,
)
from dualbrain.simulation.scenes.colours import COLOUR_RGBA

STEP = 0.002
places = st.tuples(st.floats(0.3, 0.7), st.floats(-0.4, 0.4), st.floats(-np.pi, np.pi))
halves = st.tuples(st.floats(0.015, 0.05), st.floats(0.015, 0.05), st.floats(0.015, 0.1))


def rendered_colour(name):
    return np.clip(COLOUR_GAIN * np.array(COLOUR_RGBA[name][:3]) + COLOUR_OFFSET, 0.0, 1.0)


def box_points(half, at, yaw):
    """Points on the top and the four sides of a box, as visible from above and from the sides."""
    a, b, c = half
    x, y = (np.arange(-s, s + 1e-9, STEP) for s in (a, b))
    z = np.arange(0.0, 2 * c + 1e-9, STEP)
    top = [(u, v, 2 * c) for u in (*x, a) for v in (*y, b)]
    sides = [(s, v, w) for s in (-a, a) for v in y for w in z] + [(u, s, w) for s in (-b, b) for u in x for w in z]
    return moved(np.array(top + sides), at, yaw)


def ring_points(radius, height, at, floor=None):
    """Points on a cylinder, or with the inner height `floor` [m] on a bowl."""
    angles = np.arange(0.0, 2 * np.pi, STEP / radius)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    wall = [(*(radius * c), w) for c in circle for w in np.arange(0.0, height + 1e-9, STEP)]
    inside = [
        (*(r * c), height if floor is None else floor)
        for r in np.arange(0.0, radius - 0.004, STEP)
        for c in circle[:: max(1, round(radius / max(r, STEP)))]
    ]
    return moved(np.array(wall + inside), at, 0.0)


def moved(points, at, yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([points[:, :2] @ np.array([[c, s], [-s, c]]) + at, points[:, 2]])


def fit_with_table(points, colour="green"):
    table = np.column_stack([np.random.default_rng(0).uniform(0, 1, (500, 2)), np.zeros(500)])
    return fit_primitives(np.vstack([points, table]), np.tile(rendered_colour(colour), (len(points) + 500, 1)))


@given(halves, places)
@settings(max_examples=25, deadline=None)
def test_a_box_is_recovered(half, place):
    x, y, yaw = place
    (one,) = fit_with_table(box_points(half, (x, y), yaw))
    if isinstance(one.shape, Cylinder):
        pytest.fail("a box was classified as a cylinder")
    assert np.allclose(one.pose.position, (x, y, half[2]), atol=0.003)
    assert np.allclose(sorted(one.shape.half_extents[:2]), sorted(half[:2]), atol=0.003)
    assert one.shape.half_extents[2] == pytest.approx(half[2], abs=0.002)
    fitted = 2.0 * np.arctan2(one.pose.quaternion[3], one.pose.quaternion[0])
    error = (fitted - yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4
    assert abs(error) < 0.12


@given(st.floats(0.018, 0.05), st.floats(0.03, 0.2), places)
@settings(max_examples=25, deadline=None)
def test_a_cylinder_is_recovered(radius, height, place):
    (one,) = fit_with_table(ring_points(radius, height, place[:2]))
    assert isinstance(one.shape, Cylinder)
    assert np.allclose(one.pose.position, (*place[:2], height / 2), atol=0.003)
    assert one.shape.radius == pytest.approx(radius, abs=0.003)


def test_a_hollow_wide_circle_is_a_bowl_and_a_full_one_is_not():
    (bowl,) = fit_with_table(ring_points(0.085, 0.05, (0.5, 0.2), floor=0.008))
    assert isinstance(bowl.shape, Bowl)
    assert bowl.pose.position[2] == 0.0
    (puck,) = fit_with_table(ring_points(0.085, 0.05, (0.5, 0.2)))
    assert isinstance(puck.shape, Cylinder)


def test_two_centimetres_separate_objects_and_five_millimetres_do_not():
    for gap, count in ((0.02, 2), (0.005, 1)):
        pair = [box_points((0.02, 0.02, 0.03), (0.5, y), 0.0) for y in (0.0, 0.04 + gap)]
        assert len(fit_with_table(np.vstack(pair))) == count


def test_an_empty_table_has_no_primitive():
    assert fit_with_table(np.zeros((0, 3))) == []


@pytest.mark.parametrize("name", OBJECT_COLOURS)
def test_a_colour_is_classified_under_slightly_different_light(name):
    for light in (0.97, 1.0, 1.03):
        assert nearest_colour(np.clip(light * rendered_colour(name), 0.0, 1.0)) == name
