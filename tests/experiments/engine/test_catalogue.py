"""A seeded sample of the big proofs, and the shape of all of them."""

import pytest

from dualbrain.simulation.scenes.generators.tabletop import make_scene
from experiments.engine.catalogue import EXPERIMENTS
from experiments.engine.experiment import Options
from experiments.planning.contract_sensitivity import FAMILIES
from experiments.planning.end_to_end import EndToEnd, FilterAblation, ReplayedPlanner
from experiments.planning.sensitivity_sweep import SensitivitySweep
from experiments.robots.grasping import Grasping, grasp_candidates
from experiments.safety.closed_loop import count_violations, succeeded
from experiments.safety.no_obstacles import NoObstacles

SAMPLE = (0, 7, 13, 19, 26, 33)


@pytest.mark.parametrize(
    "proof", [proof for proof in EXPERIMENTS.values() if proof.name != "kernel"], ids=lambda p: p.name
)
def test_keys_are_unique_and_the_order_is_fixed(proof, tmp_path):
    options = Options(tmp_path, "nobody")
    keys = [unit.key for unit in proof.units(options)]
    assert len(keys) == len(set(keys))
    assert keys == [unit.key for unit in proof.units(options)]


def test_sizes(tmp_path):
    options = Options(tmp_path, "nobody")
    assert len(EndToEnd().units(options)) == 60
    assert len(Grasping().units(options)) == 40
    assert FilterAblation().units(options) == []
    abouts = [unit.parameters for unit in SensitivitySweep().units(options)]
    for family in FAMILIES:
        flown = [
            one["parameters"] for one in abouts if (one["family"], one["seed"], one["again"]) == (family, 0, False)
        ]
        assert len([contract for contract in flown if contract["speed"] == 0.2]) >= 24


def test_what_is_picked_stands_free_and_differs():
    ranked = [grasp_candidates(make_scene("tabletop", seed)) for seed in range(10)]
    assert all(line[0][0] >= 0.08 for line in ranked)
    assert all(name != "blue_bowl" for line in ranked for _, name, _ in line)


def test_six_seeded_picks():
    proof = Grasping()
    rows = [{"key": str(seed), **proof.run({"seed": seed})} for seed in SAMPLE]
    assert [row["key"] for row in rows if not row["truth"]] == []
    assert not count_violations(rows)


def _fast(units):
    """One contract of each grid at full speed."""
    fast = [unit for unit in units if unit.about["actions"][0]["params"]["speed"] == 0.4]
    return {unit.about["grid"]: unit for unit in reversed(fast)}.values()


def test_a_bare_contract_of_each_grid_is_left_alone(tmp_path):
    proof = NoObstacles()
    quick = _fast(proof.units(Options(tmp_path, "")))
    for unit in quick:
        row = proof.run(unit.parameters)
        assert succeeded(row), row["reason"]
        assert row["delta_max"] == 0.0


def test_retold_answers_come_in_order():
    planner = ReplayedPlanner([["a", "length"], ["b", "stop"]])
    said = [planner.propose(None) for _ in range(2)]
    assert [(answer.text, answer.finish_reason) for answer in said] == [("a", "length"), ("b", "stop")]
