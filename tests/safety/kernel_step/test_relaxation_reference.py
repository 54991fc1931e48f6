"""Relaxed, faulty and certified results of random cases against numpy: the same control, the same relaxed ranks."""

import numpy as np
import pytest

from tests.safety.kernel_step import random_cases
from tests.safety.kernel_step.reference_relaxation import ReferenceRelaxation
from tests.safety.kernel_step.test_step_internals import KINDS, run_both


def hard(rng, kind):
    """A random case that may be infeasible: a fast start between many obstacles."""
    found = run_both(rng, 7, 6, kind, ReferenceRelaxation, crowded=True)
    if found is None:
        return None
    _, _, _, answer, got, w = found
    values = got["rows"]
    names = [tuple(int(values[e][r]) for e in ("kind", "i", "j")) for r in range(int(values["count"][0]))]
    return answer, w, names


@pytest.mark.parametrize("kind", ["everything", "still", "mobile"])
def test_what_is_given_up_is_the_least_rank_by_rank(kind):
    rng = np.random.default_rng(len(kind))
    relaxed = certified = moved = faults = 0
    for _ in range(100):
        found = hard(rng, kind)
        if found is None:
            continue
        answer, w, names = found
        assert answer.certified == (answer.status != 4)
        if answer.certified:
            certified += 1
            assert w.keeps_barriers(np.array(answer.u))
        else:
            faults += 1
            assert not w.keeps_barriers(w.brake_target, 1e-12), "braking is the last resort"
        if answer.status == 2 and names and set(names) == set(w.rows) and not w.zero_gradient_rows:
            expected = w.solve_relaxation(names)
            u, relaxed_mask = expected or (None, 0)
            if expected and w.keeps_barriers(u, 1e-12):
                np.testing.assert_allclose(answer.u, u, atol=2e-7)
                assert answer.relaxed_mask == relaxed_mask
                relaxed += 1
                moved += any(w.rows[name][5] for name in names)
    assert min(relaxed, certified) > 3, (relaxed, certified, faults)
    assert moved > 0 or not KINDS[kind].get("moving", True)


def test_a_step_reads_nothing_that_it_has_not_written():
    """With any initial bytes in memory the results are equal."""
    for kind in ("everything", "crowd", "alone"):
        rng = np.random.default_rng(4)
        found = None
        while found is None:
            found = run_both(rng, 8, 6, kind)
        _, model, m, answer, got, _ = found
        for byte in (0xFF, 0x5A):
            made = random_cases.make_kernel(model)
            made.fill_memory(byte)
            random_cases.upload_case(made, model, m)
            again = random_cases.run_step(made, m)
            assert np.array_equal(again.u, answer.u)
            values = (
                "delta",
                "delta_rows",
                "delta_box",
                "h_min",
                "status",
                "flags",
                "certified",
                "n_rows",
                "binding_rows",
                "relaxed_mask",
            )
            assert [getattr(again, name) for name in values] == [getattr(answer, name) for name in values]
            fresh = random_cases.step_internals(made, model["n"], len(model["link_frame"]))
            for name in ("trust_speed", "max_speed", "sampling_term", "bound_r"):
                assert np.array_equal(fresh["motion"][name][:7], got["motion"][name][:7]), name
