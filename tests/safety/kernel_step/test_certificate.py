"""The certificate and what it looks at, to a fraction of a millimetre: margins by name, own parts, things that went."""

import numpy as np
import pytest

from tests.safety.kernel_step import random_cases
from tests.safety.kernel_step.random_cases import StepCase
from tests.safety.kernel_step.reference_rows import ReferenceRows
from tests.safety.kernel_step.test_numeric_limits import ERROR, MARGIN, ball_row, chain_model
from tests.safety.kernel_step.test_step_internals import run_both

FAULT = 4
SPEED = 1.0
"""[m/s] of the tip toward the ball; it can brake by 5 mm/s in a period, in which it goes 1 mm."""
AGE, HELD = 0.1, np.array([[0.1, 0.0, 0.0, 0.02]])
BESIDE = [[0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0]]

MARGINS = {
    "none": (0.0, {}, {}, {}),
    "its own": (0.003, {}, {f"c{MARGIN}": 0.003}, {}),
    "rounding": (0.003, {"rounding": 0.003}, {}, {}),
    "age": (0.003, {}, {f"c{ERROR}": 0.03, "c1": 0.0}, {}),
    "what is held": (0.003, {"spheres": BESIDE}, {}, {"held": HELD, "held_error": 0.003}),
}
"""What is taken off the distance [m], and by which change of the body, of the ball's row, of the moment."""


def rushing(model, things, **more):
    """A step of an arm at full speed toward +y."""
    made = random_cases.make_kernel(model)
    u = np.full(2, 2.0)
    m = StepCase(np.zeros(2), np.zeros(2), u, u, np.array(things, float).reshape(-1, 29), age=AGE, **more)
    m.rows = np.empty((0, 5))
    random_cases.upload_case(made, model, m)
    return random_cases.run_step(made, m)


@pytest.mark.parametrize("name", MARGINS)
def test_the_certificate_keeps_just_the_margins_there_are(name):
    """0.6 mm too near after one period is a fault, 0.6 mm to spare is none: braking changes 0.01 mm of that."""
    margin, body, row, moment = MARGINS[name]
    for left, fault in ((-0.6e-3, True), (0.6e-3, False)):
        away = 0.05 + 0.02 + margin + 1e-3 * SPEED + left
        answer = rushing(chain_model(**body), [ball_row((0.7, away, 0.0), **row)], **moment)
        assert (answer.status == FAULT, answer.certified) == (fault, not fault)


@pytest.mark.parametrize(
    ("margins", "held"), [({}, False), ({"self_margin": 3e-3}, False), ({"rounding": 3e-3}, False), ({}, True)]
)
def test_the_certificate_keeps_own_parts_apart_by_their_margins(margins, held):
    margin = sum(margins.values()) + 3e-3 * held
    for left, fault in ((-0.6e-3, True), (0.6e-3, False)):
        mount = [0.7, 0.02 + 0.05 + margin + 1e-3 * SPEED + left, 0.0, 0.05, 0.0, 0.0, 0.0]
        tip = BESIDE[0] if held else [0.1, 0.0, 0.0, 0.02, 0.0, 0.0, 0.0]
        kept = {"held_links": np.zeros(1)} if held else {"pairs": np.array([0.0, 1.0])}
        model = chain_model(spheres=[mount, tip], frames=(0, 2), counts=(1, 1), **kept, **margins)
        answer = rushing(model, [], **({"held": HELD, "held_error": 3e-3} if held else {}))
        assert (answer.status == FAULT, answer.certified) == (fault, not fault)


def test_own_parts_are_looked_at_again_just_as_far_as_a_period_could_bring_them():
    """Pairs are moved to either side of that distance, by a margin that all have."""
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


def test_a_thing_that_is_gone_holds_nothing_back():
    """Eight rows fill a vector; the ninth, which bound the last step, still lies behind them."""
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
