"""Batches: equal to single calls bit for bit, without memory between rows."""

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.errors import ConfigurationError
from dualbrain.robots.differential_drive import make_differential_base
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import Bound
from dualbrain.safety.cbf.filter import ConstraintRow, Contact, FilterStatus, Obstacle, SafetyFilter
from tests.safety import random_scenes

PANDA = load_robot("panda")
SMALL = msgspec.structs.replace(PANDA, spheres=PANDA.spheres[::4])
V_MAX = np.array([joint.velocity.value for joint in PANDA.joints])
COMING = Obstacle(
    "hand", Sphere(0.06), Pose((0.55, 0.0, 0.75)), velocity=(0.0, 0.0, -0.3), velocity_error=0.1, static=False
)


def make_filter(obstacles, stamp=0.0, **changes):
    """A filter with a permit and a user row, so that both are covered by the comparison."""
    safety = SafetyFilter(SMALL, random_scenes.exact_config(lag_compensation=True, **changes))
    safety.observe(obstacles, stamp)
    safety.permit([Contact("hand", "thing1", 0.02)])
    safety.constrain([ConstraintRow(name="never left", a=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), b=-0.4)])
    return safety


def states(rng, m):
    """States near home and anywhere, moving and at rest, with nominals up to twice the limits; some are invalid."""
    near = rng.random((m, 1)) < 0.7
    low, high = np.array([(j.lower.value, j.upper.value) for j in PANDA.joints]).T
    Q = np.where(near, np.array(PANDA.home) + rng.normal(0.0, 0.25, (m, 7)), rng.uniform(low, high, (m, 7)))
    V = rng.uniform(-1.0, 1.0, (m, 7)) * V_MAX * (rng.random((m, 1)) < 0.6)
    U = rng.uniform(-2.0, 2.0, (m, 7)) * V_MAX
    U[rng.random(m) < 0.03, 2] = np.nan
    return Q, V, U


def one_by_one(safety, Q, V, U, last, opening, now):
    """Results of the same rows as the first calls after `reset`."""
    answers = []
    for q, v, u, u_prev, gap in zip(Q, V, U, last, opening, strict=True):
        safety.reset(u_prev)
        answers.append(safety(q, v, u, now, opening=gap))
    return answers


def same(batch, answers):
    assert np.array_equal(batch.u, [answer.u for answer in answers])
    assert batch.status.tolist() == [answer.status for answer in answers]
    assert np.array_equal(batch.delta, [answer.delta for answer in answers])
    assert np.array_equal(batch.h_min, [answer.h_min for answer in answers], equal_nan=True)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from(["float32", "float64"]))
def test_a_batch_is_single_calls_bit_for_bit(seed, real):
    rng = np.random.default_rng(seed)
    obstacles, now = [*random_scenes.random_scene(SMALL, rng), COMING], 0.21
    Q, V, U = states(rng, 40)
    last, opening = rng.uniform(-1.0, 1.0, (40, 7)) * V_MAX, rng.uniform(0.0, 0.04, 40)
    batch = make_filter(obstacles, 0.1, precision=real).batch(Q, V, U, now, u_prev=last, opening=opening)
    same(batch, one_by_one(make_filter(obstacles, 0.1, precision=real), Q, V, U, last, opening, now))
    order = rng.permutation(40)
    turned = make_filter(obstacles, 0.1, precision=real).batch(
        Q[order], V[order], U[order], now, u_prev=last[order], opening=opening[order]
    )
    assert np.array_equal(turned.u, batch.u[order]), "a row depends on earlier rows"


def test_the_comparison_covers_every_status():
    rng = np.random.default_rng(4)
    Q, V, U = states(rng, 1500)
    U[::5] = V[::5]
    batch = make_filter([*random_scenes.random_scene(SMALL, rng), COMING]).batch(Q, V, U)
    assert set(batch.status.tolist()) == set(FilterStatus)
    assert np.all(np.isfinite(batch.u))
    assert np.all(np.abs(batch.u) <= V_MAX)


def test_the_velocity_is_the_last_control_unless_it_is_given():
    rng = np.random.default_rng(1)
    safety = make_filter(random_scenes.random_scene(SMALL, rng))
    Q, V, U = states(rng, 60)
    assert np.array_equal(safety.batch(Q, V, U).u, safety.batch(Q, V, U, u_prev=V).u)
    assert not np.array_equal(safety.batch(Q, V, U).u, safety.batch(Q, V, U, u_prev=0.0 * V).u)


def test_a_batch_does_not_change_the_memory_of_the_filter(state_at):
    rng = np.random.default_rng(2)
    obstacles = random_scenes.random_scene(SMALL, rng)
    used, alone = make_filter(obstacles), make_filter(obstacles)
    q, u_nom = np.array(PANDA.home), np.zeros(7)
    for tick in range(300):
        desired = V_MAX * np.sign(np.sin(0.02 * tick + np.arange(7)))
        answers = [safety(q, np.zeros(7), desired) for safety in (used, alone)]
        assert np.array_equal(answers[0].u, answers[1].u)
        used.batch(*states(rng, 3))
        projected = [safety.project(state_at(q), desired, u_nom, 0.0) for safety in (used, alone)]
        assert np.array_equal(*projected)
        q, u_nom = q + 1e-3 * answers[0].u, projected[0]


def test_an_empty_batch_and_rejected_batches():
    safety, none = make_filter([]), np.empty((0, 7))
    assert safety.batch(none, none, none).u.shape == (0, 7)
    for shape in ((7,), (3, 6), (2, 7)):
        with pytest.raises(ConfigurationError, match=r"\(m, 7\)"):
            safety.batch(np.zeros((3, 7)), np.zeros(shape), np.zeros((3, 7)))
    fast = Bound(1.0, "m/s", "test")
    cart = make_differential_base(
        "cart",
        [(0.2, 0.0, 0.1)],
        speed=fast,
        turn_rate=fast,
        acceleration=fast,
        turn_acceleration=fast,
        tracking=PANDA.tracking,
    )
    for rejected in (SafetyFilter(SMALL, barriers=[_NoRows()]), SafetyFilter(cart)):
        with pytest.raises(ConfigurationError, match="fixed base and no Python barriers"):
            rejected.batch(none, none, none)


class _NoRows:
    def rows(self, state, jacobian):
        return ()
