"""The certificate to a fraction of a millimetre: margins by name, self-collision, and removed obstacles."""

import numpy as np
import pytest

from tests.safety.kernel_step import random_cases
from tests.safety.kernel_step.random_cases import StepCase
from tests.safety.kernel_step.reference_rows import ReferenceRows
from tests.safety.kernel_step.test_numeric_limits import ERROR, MARGIN, ball_row, chain_model
from tests.safety.kernel_step.test_step_internals import run_both

FAULT = 4
SPEED = 1.0
"""Speed of the tip toward the sphere [m/s]; it brakes by at most 5 mm/s per period, in which it moves 1 mm."""
AGE, HELD = 0.1, np.array([[0.1, 0.0, 0.0, 0.02]])
BESIDE = [[0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0]]

MARGINS = {
    "none": (0.0, {}, {}, {}),
    "its own": (0.003, {}, {f"c{MARGIN}": 0.003}, {}),
    "rounding": (0.003, {"rounding": 0.003}, {}, {}),
    "age": (0.003, {}, {f"c{ERROR}": 0.03, "c1": 0.0}, {}),
    "held object": (0.003, {"spheres": BESIDE}, {}, {"held": HELD, "held_error": 0.003}),
}
"""Expected margin [m], and the change of the model, of the row of the sphere, and of the case that causes it."""


def rushing(model, obstacles, **more):
    """The result of one step of an arm that moves at full speed toward +y."""
    made = random_cases.make_kernel(model)
    u = np.full(2, 2.0)
    m = StepCase(np.zeros(2), np.zeros(2), u, u, np.array(obstacles, float).reshape(-1, 29), age=AGE, **more)
    m.rows = np.empty((0, 5))
    random_cases.upload_case(made, model, m)
    return random_cases.run_step(made, m)


@pytest.mark.parametrize("name", MARGINS)
def test_the_certificate_uses_exactly_the_defined_margins(name):
    """0.6 mm too close after one period is a fault, 0.6 mm of clearance is not; braking changes only 0.01 mm."""
    margin, model_change, row, case = MARGINS[name]
    for left, fault in ((-0.6e-3, True), (0.6e-3, False)):
        away = 0.05 + 0.02 + margin + 1e-3 * SPEED + left
        answer = rushing(chain_model(**model_change), [ball_row((0.7, away, 0.0), **row)], **case)
        assert (answer.status == FAULT, answer.certified) == (fault, not fault)


@pytest.mark.parametrize(
    ("margins", "held"), [({}, False), ({"self_margin": 3e-3}, False), ({"rounding": 3e-3}, False), ({}, True)]
)
def test_the_certificate_uses_the_margins_of_self_collision(margins, held):
    margin = sum(margins.values()) + 3e-3 * held
    for left, fault in ((-0.6e-3, True), (0.6e-3, False)):
        mount = [0.7, 0.02 + 0.05 + margin + 1e-3 * SPEED + left, 0.0, 0.05, 0.0, 0.0, 0.0]
        tip = BESIDE[0] if held else [0.1, 0.0, 0.0, 0.02, 0.0, 0.0, 0.0]
        kept = {"held_links": np.zeros(1)} if held else {"pairs": np.array([0.0, 1.0])}
        model = chain_model(spheres=[mount, tip], frames=(0, 2), counts=(1, 1), **kept, **margins)
        answer = rushing(model, [], **({"held": HELD, "held_error": 3e-3} if held else {}))
        assert (answer.status == FAULT, answer.certified) == (fault, not fault)


def test_self_collision_pairs_are_rechecked_within_the_reach_of_one_period():
    """A common margin moves pairs to either side of that distance."""
    rng, seen = np.random.default_rng(5), 0
    while seen < 12:
        found = run_both(rng, 7, 6, "alone")
        if found is None:
            continue
        made, model, m, _, _, w = found
        pairs = [
            ((near, far), float(h.min()))
            for (near, far, _), h in w.all_self_distances()
            if w.excess_between(near, far) > 0.1
        ]
        if not pairs:
            continue
        (near, far), h = pairs[rng.integers(len(pairs))]
        soon = model["period"] * (w.closing_speeds(near, far)[1] + w.excess_between(near, far)) + 1e-3
        for more in (-1e-7, 1e-7):
            moved = model | {"self_margin": model["self_margin"] + h - soon - more}
            made = random_cases.make_kernel(moved)
            random_cases.upload_case(made, moved, m)
            if random_cases.run_step(made, m).status > 1:
                continue
            at = random_cases.step_internals(made, 7, 6)["step"]
            box, trust = (
                (at[low][:7], at[high][:7]) for low, high in (("lower", "upper"), ("trust_lower", "trust_upper"))
            )
            visits = {
                tuple(int(at[e][r]) for e in ("revisit_first", "revisit_spheres", "revisit_other"))
                for r in range(int(at["revisits"][0]))
            }
            assert visits == ReferenceRows(moved, m, box, trust).revisit_pairs
            seen += 1


def test_a_removed_obstacle_has_no_effect():
    """Eight rows fill a vector; the ninth row, which bound in the last step, is still in memory behind them."""
    behind, ahead = ball_row((0.7, -0.0705, 0.0)), ball_row((0.7, 0.0705, 0.0))
    made, u_nom = random_cases.make_kernel(model := chain_model()), np.full(2, 1.0)
    m = StepCase(np.zeros(2), np.zeros(2), u_nom, np.zeros(2), np.array([behind] * 8 + [ahead]), rows=np.empty((0, 5)))
    random_cases.upload_case(made, model, m)
    first = random_cases.run_step(made, m)
    assert [row[:3] for row in first.binding_rows if row[0] == 0] == [(0, 0, 8)]
    made.set_obstacles(np.array([behind] * 8))
    then = random_cases.run_step(made, m)
    assert then.n_rows == 8
    np.testing.assert_allclose(then.u, first.u + model["a_max"] * model["period"], atol=1e-12)
