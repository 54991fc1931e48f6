"""The mobile base: barrier rows agree with finite differences along arcs, and the filter steers around obstacles."""

import msgspec
import numpy as np
import pytest

from dualbrain.robots.differential_drive import integrate_configuration
from dualbrain.safety.barriers.keep_out import keep_out_region, scenario_base
from dualbrain.safety.barriers.scenarios import EXACT_TRACKING
from dualbrain.safety.cbf.filter import ConstraintRow, SafetyFilter


def gaps(safety, q, x, y, half_x, half_y):
    """Gap of every disc to a rectangle [m], in float64."""
    c, s = np.cos(q[2]), np.sin(q[2])
    centres = np.array([sphere.centre[:2] for sphere in safety.robot_model.spheres])
    discs = centres @ np.array([[c, s], [-s, c]]) + q[:2]
    outside = np.maximum(np.abs(discs - (x, y)) - (half_x, half_y), 0.0)
    return np.linalg.norm(outside, axis=1) - safety.robot_model.spheres[0].radius


@pytest.mark.parametrize("seed", range(10))
def test_rows_are_derivatives_of_h_along_arcs(seed):
    rng = np.random.default_rng(seed)
    safety = SafetyFilter(scenario_base(), msgspec.structs.replace(EXACT_TRACKING, acceleration_limits=False))
    region = (1.0, 0.2, 0.3, 0.4)
    safety.observe([keep_out_region("region", *region)])
    q = np.array([rng.uniform(0.2, 0.45), rng.uniform(-0.6, 0.6), rng.uniform(-3.0, 3.0)])
    safety(q, np.zeros(2), np.zeros(2))
    rows = safety._kernel.rows()
    assert rows
    u = rng.uniform(-0.5, 0.5, 2)
    ahead, back = (
        gaps(safety, integrate_configuration(q, u, 1e-4), *region),
        gaps(safety, integrate_configuration(q, u, -1e-4), *region),
    )
    for _, i, _, _, norm, _, a in rows:
        assert norm * np.dot(a, u) == pytest.approx((ahead[i] - back[i]) / 2e-4, abs=1e-4)


def test_the_base_steers_around_a_rectangle_instead_of_braking():
    """The base, which is aimed at the corner of the rectangle, turns away and passes it."""
    safety = SafetyFilter(scenario_base(), EXACT_TRACKING)
    region = (1.3, 0.51, 0.3, 0.3)
    safety.observe([keep_out_region("region", *region)])
    q, least = np.array([0.0, 0.0, 0.0]), np.inf
    for _ in range(400):
        q = integrate_configuration(q, safety(q, np.zeros(2), np.array([0.4, 0.0])).u, 0.02)
        least = min(least, gaps(safety, q, *region).min())
    assert least >= 0.0
    assert q[0] > 1.8
    assert q[1] < -0.01


def test_spheres_and_tool_are_in_the_world_frame():
    safety = SafetyFilter(scenario_base(), EXACT_TRACKING)
    q = np.array([1.0, -2.0, np.pi / 2])
    np.testing.assert_allclose(safety.tool(q).position, [1.0, -2.0, 0.0], atol=1e-6)
    centres, _, _ = safety.spheres(q, 0.0)
    x, y, _ = safety.robot_model.spheres[0].centre
    np.testing.assert_allclose(centres[0], [1.0 - y, -2.0 + x, 0.0], atol=1e-6)


class SpeedCap:
    """A live barrier: forward speed of at most 0.1 m/s."""

    def rows(self, state, jacobian):
        assert state.q.shape == (3,), "a live barrier receives the configuration in the world"
        return (ConstraintRow(name="user_rows: speed_cap", a=(-1.0, 0.0), b=-0.1),)


def test_live_barriers_work_on_a_base():
    safety = SafetyFilter(scenario_base(), EXACT_TRACKING, barriers=(SpeedCap(),))
    q, answer = np.array([0.5, -0.3, 0.7]), None
    for _ in range(30):
        answer = safety(q, np.zeros(2), np.array([0.6, 0.0]))
    assert answer.u[0] == pytest.approx(0.1, abs=1e-4)
