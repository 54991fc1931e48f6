"""Every failure class has an example, except those without a known one; the cheap ones end in their class again."""

from __future__ import annotations

import pytest

from dualbrain.evaluation.analysis.failure_taxonomy import FAILURE_CLASSES
from experiments.evaluation.failure_examples import FailureExample, FailureExamples, failure_examples, replay

WITHOUT_EXAMPLE = {"simulator", "goal missed", "incomplete plan"}
CHEAP = [one for one in failure_examples() if one.cheap]


def test_every_class_has_one_example():
    """A class gets its example together with its removal from `WITHOUT_EXAMPLE`."""
    assert sorted(one.failure for one in failure_examples()) == sorted(set(FAILURE_CLASSES) - WITHOUT_EXAMPLE)
    assert len(CHEAP) >= 5


@pytest.mark.parametrize("example", CHEAP, ids=lambda one: one.failure)
def test_a_cheap_example_ends_in_its_class_again(example: FailureExample):
    found, evidence = replay(example)
    assert found == example.failure, evidence


def test_the_table_names_an_example_that_no_longer_ends_in_its_class():
    row = {
        "key": "grasp",
        "failure": "grasp",
        "about": "a",
        "scene": "s",
        "outcome": "failed",
        "reason": "r",
        "kinds": [],
    }
    good, bad = (FailureExamples().report([{**row, "found": found}]) for found in ("grasp", "drive"))
    assert good[0].startswith("1 of 1")
    assert bad[0].startswith("0 of 1")
    assert any("no: drive" in line for line in bad)
