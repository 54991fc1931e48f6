"""The units of all experiments, and a sample of the large ones."""

import pytest

from dualbrain.planner.protocol import describe_failure, has_answer
from dualbrain.planner.scripted import RecordedAnswers
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from experiments.engine.catalogue import EXPERIMENTS
from experiments.engine.experiment import Options
from experiments.planning.contract_sensitivity import FAMILIES
from experiments.planning.end_to_end import EndToEnd, FilterAblation
from experiments.planning.sensitivity_sweep import SensitivitySweep
from experiments.robots.grasping import Grasping, grasp_candidates
from experiments.safety.closed_loop import count_violations, succeeded
from experiments.safety.no_obstacles import NoObstacles

SAMPLES = ((7, 26), pytest.param((0, 13, 19, 33), marks=pytest.mark.slow))


@pytest.mark.parametrize(
    "experiment",
    [experiment for experiment in EXPERIMENTS.values() if experiment.name != "slow_tests"],
    ids=lambda experiment: experiment.name,
)
def test_keys_are_unique_and_the_order_is_fixed(experiment, tmp_path):
    options = Options(tmp_path, "some-planner")
    keys = [unit.key for unit in experiment.units(options)]
    assert len(keys) == len(set(keys))
    assert keys == [unit.key for unit in experiment.units(options)]


def test_numbers_of_units(tmp_path):
    options = Options(tmp_path, "some-planner")
    assert len(EndToEnd().units(options)) == 60
    assert len(Grasping().units(options)) == 40
    assert FilterAblation().units(options) == []
    parameters = [unit.parameters for unit in SensitivitySweep().units(options)]
    for family in FAMILIES:
        contracts = [
            one["parameters"] for one in parameters if (one["family"], one["seed"], one["again"]) == (family, 0, False)
        ]
        assert len([contract for contract in contracts if contract["speed"] == 0.2]) >= 24


def test_grasp_candidates_are_free_of_neighbours():
    candidates = [grasp_candidates(make_scene("tabletop", seed)) for seed in range(10)]
    assert all(line[0][0] >= 0.08 for line in candidates)
    assert all(name != "blue_bowl" for line in candidates for _, name, _ in line)


@pytest.mark.parametrize("seeds", SAMPLES)
def test_seeded_grasps_succeed(seeds):
    experiment = Grasping()
    rows = [{"key": str(seed), **experiment.run({"seed": seed})} for seed in seeds]
    assert [row["key"] for row in rows if not row["truth"]] == []
    assert not count_violations(rows)


def _fast(units):
    """Return one contract of each grid at the highest speed."""
    fast = [unit for unit in units if unit.parameters["actions"][0]["params"]["speed"] == 0.4]
    return {unit.parameters["grid"]: unit for unit in reversed(fast)}.values()


def test_the_filter_does_not_change_a_fast_contract_of_each_grid(tmp_path):
    experiment = NoObstacles()
    fast = _fast(experiment.units(Options(tmp_path, "")))
    for unit in fast:
        row = experiment.run(unit.parameters)
        assert succeeded(row), row["reason"]
        assert row["delta_max"] == 0.0


def test_replayed_answers_keep_their_order():
    planner = RecordedAnswers([["a", "length"], ["b", "stop"]])
    answers = [planner.propose(None) for _ in range(2)]
    assert [(answer.text, answer.finish_reason) for answer in answers] == [("a", "length"), ("b", "stop")]


def test_a_request_beyond_the_recorded_answers_has_none():
    planner = RecordedAnswers([["a", "stop"]])
    planner.propose(None)
    beyond = planner.propose(None)
    assert not has_answer(beyond)
    assert describe_failure(beyond.finish_reason).endswith("more answers were requested than are recorded")
