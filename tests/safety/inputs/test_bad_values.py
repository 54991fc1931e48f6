"""Bad values at every interface that takes geometric input, drawn at random and one of each kind for every field."""

import os

import numpy as np
import pytest

from experiments.interfaces.bad_input import BadInput, all_interfaces, run_case
from experiments.interfaces.bad_values import KINDS, VALID

CASES = int(os.environ.get("DUALBRAIN_BAD_VALUES", "4000"))
"""Number of random cases; `python -m experiments run bad-input` runs a million."""
SEED = 20261125


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_random_bad_values_are_refused_or_stop_the_robot():
    row = BadInput().run({"seed": SEED, "cases": CASES})
    assert row["cases"] == CASES
    assert row["problems"] == []
    assert set(row["kinds"]) == {*KINDS, VALID}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", all_interfaces())
def test_every_field_refuses_every_kind_and_takes_valid_values(name):
    rng = np.random.default_rng(SEED)
    for field in all_interfaces()[name].fields:
        for kind in (*KINDS, VALID):
            assert run_case(name, field, kind, rng) == "", (field, kind)
