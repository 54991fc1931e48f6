"""The fuzzing of observations and documents: every case is counted, and a wrong answer would be reported."""

import numpy as np
import pytest

from dualbrain.safety.cbf.filter import FilterStatus
from experiments.interfaces import fuzz_observations
from experiments.interfaces.fuzz_documents import SAMPLES, FuzzDocuments
from experiments.interfaces.fuzz_observations import FuzzObservations, _problem


def test_observations_are_counted_and_have_no_wrong_answer(monkeypatch):
    monkeypatch.setattr(fuzz_observations, "WARM_UP", 20)
    row = FuzzObservations().run({"seed": 3, "observations": 300})
    assert row["problems"] == []
    counts = row["counts"]
    assert counts["accepted"] + counts["refused: GeometryError"] == 300
    assert "**300** observations, **0** wrong answers" in "\n".join(FuzzObservations().report([row]))


@pytest.mark.parametrize(
    ("outcome", "status", "u", "words"),
    [
        ("raised: ValueError", FilterStatus.STOPPED, 0.0, "raised"),
        ("refused: GeometryError", FilterStatus.SAFE, 0.0, "but the step was SAFE"),
        ("accepted", FilterStatus.SAFE, 9.0, "not within the limits"),
        ("accepted", FilterStatus.SAFE, np.nan, "not within the limits"),
    ],
)
def test_a_wrong_answer_is_a_problem(outcome, status, u, words):
    assert words in _problem(outcome, status, np.full(7, u), [2.0] * 7)
    assert _problem("accepted", FilterStatus.SAFE, np.zeros(7), [2.0] * 7) == ""


@pytest.mark.parametrize("kind", SAMPLES)
def test_documents_are_counted(kind):
    experiment = FuzzDocuments()
    row = {"key": "one", **experiment.run({"kind": kind, "seed": 1, "documents": 25})}
    assert row["failure"] == ""
    assert sum(row["counts"].values()) == 25
    assert f"| {kind} | 25 |" in "\n".join(experiment.report([row]))
