"""Clipped affine maps: composition, shares of an update, and a million updates."""

import math
from functools import reduce

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.memory.plasticity.affine_map import IDENTITY, AffineMap
from dualbrain.memory.plasticity.hebbian_update import Plasticity

maps = st.builds(AffineMap, st.floats(0.0, 1.2), st.floats(-1.0, 1.0))


@given(st.lists(maps, min_size=1, max_size=30), st.floats(0.0, 1.0))
def test_a_sequence_of_updates_is_one_map(chain: list[AffineMap], w: float) -> None:
    """The law that makes compaction exact; the oracle applies one update after the other."""
    one = reduce(lambda so_far, update: so_far.compose(update), chain)
    assert math.isclose(one(w), reduce(lambda value, update: update(value), chain, w), abs_tol=1e-12)


@given(maps, maps, maps, st.floats(0.0, 1.0))
def test_composition_is_associative_and_has_an_identity(a: AffineMap, b: AffineMap, c: AffineMap, w: float) -> None:
    assert math.isclose(a.compose(b).compose(c)(w), a.compose(b.compose(c))(w), abs_tol=1e-12)
    assert IDENTITY.compose(a)(w) == a(w)
    assert math.isclose(a.compose(IDENTITY)(w), a(w), abs_tol=1e-15)


@given(maps, st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_a_share_of_an_update_changes_the_weight_by_that_share(update: AffineMap, w: float, share: float) -> None:
    """The change is between zero and the whole update, and never exceeds the share of the unclipped update."""
    change, whole = update.scale_step(share)(w) - w, update.gain * w + update.offset - w
    assert abs(change) <= share * abs(whole) + 1e-12
    assert change * whole >= -1e-15
    assert update.scale_step(0.0)(w) == w


def test_a_million_updates_stay_in_bounds_and_match_the_theory() -> None:
    """w after 1e6 updates: in [0, 1], and equal to the stationary law of a noisy outcome within sampling error.

    Oracle: without clipping, E[w] obeys E[w'] = (1 − ρ)E[w] + p η₊ − (1 − p) η₋ g, so E[w] = (p η₊ − (1 − p) η₋ g)/ρ.
    """
    rule, rng = Plasticity(rho=0.05, eta_plus=0.05, eta_minus=0.02, kappa=0.0), np.random.default_rng(0)
    up, down = rule.update_map(1, 0.0), rule.update_map(0, math.inf)
    good, w, total, n = rng.random(1_000_000) < 0.7, 0.5, 0.0, 1_000_000
    a, b, c, d = up.gain, up.offset, down.gain, down.offset
    for success in good.tolist():
        w = a * w + b if success else c * w + d
        w = 0.0 if w < 0.0 else min(w, 1.0)
        total += w
    expected = (0.7 * 0.05 - 0.3 * 0.02) / 0.05
    assert 0.0 <= w <= 1.0
    assert abs(total / n - expected) < 0.005
