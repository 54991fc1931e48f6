"""Weight updates: the neighbourhood, the handicap law, and failures of rules outside the constraints."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.errors import ConfigurationError
from dualbrain.memory.learning.trust import TrustConfig
from dualbrain.memory.plasticity.affine_map import AffineMap
from dualbrain.memory.plasticity.hebbian_update import Penalty, Plasticity
from dualbrain.memory.retrieval.search import FlatIndex, Query
from tests.memory.memory_samples import CONFIG, NOW, REST_POSTURE, episode, grasp_contract, open_ledger, open_memory

SCENE = "neighbour_across low"
WIDE = replace(CONFIG, plasticity=Plasticity(kappa=0.05, bandwidth=0.3), trust=TrustConfig.disabled())


@pytest.mark.parametrize(("kind", "xi"), [("succeeded", 1.0), ("failed", -1.0)])
def test_the_neighbourhood_follows_the_gaussian_of_the_paper(tmp_path: Path, kind: str, xi: float) -> None:
    """Oracle: the formula on distances between the stored vectors; the new memory itself is not its own neighbour."""
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger, WIDE)
        for name, words in (("a", "put the red cube in the bowl"), ("b", "put the red cube in a bowl"), ("c", "halt")):
            memory.store(episode(name, "declined", instruction=words), REST_POSTURE, now=NOW)
        report = memory.store(episode("new", kind, instruction="put the red cube in the bowl"), REST_POSTURE, now=NOW)
        scale = np.sqrt(memory.embedding.expand_alpha(memory.config.embedding.alpha) / 0.9).astype(float)
        rows = memory.index.rows.astype(float) * scale
        distances = ((rows - rows[3]) ** 2).sum(axis=1)
        factor = np.where(distances <= 0.81, np.exp(-distances / (2 * 0.3**2)), 0.0)
        expected = 0.5 + xi * 0.05 * factor
        got = memory.weights()
        assert [got[name] for name in "abc"] == pytest.approx(expected[:3].tolist(), abs=1e-6)
        assert (got["c"], report.n_neighbours) == (0.5, 2)
        assert got["new"] == pytest.approx(AffineMap(0.95, 0.1 if xi > 0 else -0.1)(0.5))


def test_the_outcome_of_one_contract_does_not_change_others_in_the_same_situation(tmp_path: Path) -> None:
    """Otherwise a contract that fails repeatedly would lower the weights of good contracts in the same situation."""
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger, WIDE)
        memory.store(episode("good", plan=grasp_contract("cup")), REST_POSTURE, now=NOW)
        memory.store(episode("same contract", "declined", plan=grasp_contract("jar")), REST_POSTURE, now=NOW)
        before = memory.weights()
        for number in range(20):
            memory.store(episode(f"bad {number}", "failed", plan=grasp_contract("jar")), REST_POSTURE, now=NOW)
        after = memory.weights()
        assert after["good"] == before["good"] > max(after[f"bad {number}"] for number in range(20))
        assert after["same contract"] == 0.0
        bare = {"id": "c-1", "context": {}, "action_sequence": []}
        assert memory.store(episode("nothing", "failed", plan=bare), REST_POSTURE, now=NOW).n_neighbours == 0
        assert memory.store(episode("again", "failed", plan=bare), REST_POSTURE, now=NOW).n_neighbours == 0


def test_an_outcome_updates_the_exemplar_that_was_followed(tmp_path: Path) -> None:
    """Exemplars with another contract stay unchanged; if two are equally near, both count as followed."""
    slow, fast = (grasp_contract("cup") for _ in range(2))
    slow["action_sequence"][0]["params"] |= {"speed": 0.1, "force": 5.0}
    fast["action_sequence"][0]["params"] |= {"speed": 0.3, "force": 5.0}
    between = grasp_contract("cup")
    between["action_sequence"][0]["params"] |= {"speed": 0.2, "force": 5.0}
    other = {"id": "c-1", "context": {}, "action_sequence": [{"skill": "home", "params": {}}]}
    for done, moved in ((fast, {"fast"}), (slow, {"slow"}), (between, {"slow", "fast"}), (other, set[str]())):
        with open_ledger(tmp_path, f"{moved}.db") as ledger:
            memory = open_memory(ledger, CONFIG)
            for name, plan in (("slow", slow), ("fast", fast)):
                memory.store(episode(name, plan=plan), REST_POSTURE, now=NOW)
            before = memory.weights()
            recall = memory.retrieve("put the red cube in the bowl", SCENE, REST_POSTURE, "arm", "aaaa1111", k=2)
            report = memory.store(episode("new", "failed", plan=done, recall=recall), REST_POSTURE, now=NOW)
            assert {name for name, w in memory.weights().items() if w != before.get(name, w)} == moved
            ranks = {hit.episode_id: hit.rank for hit in recall.exemplars}
            assert {one.memory: one.rank for one in report.weight_updates if one.rank} == {
                name: ranks[name] for name in moved
            }


def test_a_contract_that_fails_wherever_it_is_copied_loses_its_lead(tmp_path: Path) -> None:
    """The newest copy is nearest and starts at w₀, but the evidence about the contract counts as well."""
    words = "put the red cube in the bowl"
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger, WIDE)
        memory.store(
            episode("elsewhere", summary="neighbour_across tall", plan=grasp_contract("cup")), REST_POSTURE, now=NOW
        )
        memory.store(episode("here", plan=grasp_contract("jar")), REST_POSTURE, now=NOW)
        first = list[str]()
        for turn in range(12):
            recall = memory.retrieve(words, SCENE, REST_POSTURE, "arm", "aaaa1111", k=3)
            first.append(recall.exemplars[0].contract["action_sequence"][0]["params"]["object"])
            Delta = 0.1 if first[-1] == "jar" else 0.0
            done = episode(f"copy {turn}", Delta=Delta, plan=grasp_contract(first[-1]), recall=recall)
            memory.store(done, REST_POSTURE, now=NOW)
        assert first[0] == "jar"
        assert first[-6:] == ["cup"] * 6


def test_at_most_the_nearest_neighbours_change(tmp_path: Path) -> None:
    rule = replace(WIDE.plasticity or Plasticity(), reach=3)
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger, replace(WIDE, plasticity=rule))
        for i in range(6):
            memory.store(episode(f"e-{i}", "declined"), REST_POSTURE, now=NOW)
        assert memory.store(episode("new"), REST_POSTURE, now=NOW).n_neighbours == 3
        assert [name for name, w in memory.weights().items() if w > 0.5] == ["e-3", "e-4", "e-5", "new"]


def test_a_neighbours_outcome_never_outweighs_the_own_outcome() -> None:
    """Proposition 2 with a neighbourhood: alternating good and bad outcomes that also update each other."""
    rule = Plasticity(kappa=0.05, eta_plus=0.1, rho=0.05)
    good, bad = 0.0, 1.0
    for _ in range(200):
        good, bad = rule.update_map(1, 0.0)(good), min(1.0, bad + rule.neighbour_offset(0.0, up=True))
        bad, good = rule.update_map(0, 0.0)(bad), max(0.0, good + rule.neighbour_offset(0.0, up=False))
    assert good - bad > 0.9


@pytest.mark.parametrize(
    "setting",
    [
        {"kappa": 0.06},
        {"kappa": -0.1},
        {"bandwidth": 0.31},
        {"bandwidth": 0.0},
        {"kappa": math.nan},
        {"eta_plus": 0.05, "kappa": 0.01},
        {"reach": -1},
    ],
)
def test_neighbourhoods_that_would_outweigh_outcomes_are_refused(setting: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError, match="plasticity"):
        Plasticity(**setting)


@pytest.mark.parametrize(
    ("rho", "eta_plus", "eta_minus", "g0"),
    [(0.1, 0.01, 0.2, 0.5), (0.0, 0.1, 0.2, 0.0), (0.0, 0.0, 0.2, 0.5)],
)
def test_outside_the_constraints_proposition_2_fails(rho: float, eta_plus: float, eta_minus: float, g0: float) -> None:
    """With such values the rule of the paper does not separate, or a success lowers a weight; they are refused."""
    with pytest.raises(ConfigurationError):
        Plasticity(rho=rho, eta_plus=eta_plus, eta_minus=eta_minus, g=Penalty(floor=g0), kappa=0.0)
    good, bad, fell = 0.0, 1.0, False
    for _ in range(5000):
        after = min(1.0, max(0.0, (1.0 - rho) * good + eta_plus))
        good, bad = after, min(1.0, max(0.0, (1.0 - rho) * bad - eta_minus * g0))
    fell = min(1.0, 0.9 * (1.0 - rho) + eta_plus) < 0.9
    assert fell or good - bad <= 0.0


@given(st.floats(0.1, 0.95), st.floats(0.05, 1.0), st.floats(0.0, 0.5))
def test_the_handicap_law(lambda_s: float, gap: float, handicap: float) -> None:
    """Measured through the scan: a weight gap overcomes a similarity deficit Δs iff Δs < (1 − λ_s)/λ_s · gap."""
    limit = (1.0 - lambda_s) / lambda_s * gap
    if abs(handicap - limit) < 1e-4:
        return
    cosine = 1.0 - 2.0 * handicap
    near, far = np.array([1.0, 0.0], np.float32), np.array([cosine, math.sqrt(1.0 - cosine**2)], np.float32)
    index = FlatIndex(2)
    index.add(near, 0.0)
    index.add(far, gap)
    winner = index.top_k(index.compare(Query.single_block(near)), np.ones(2, bool), 1, lambda_s)[0].row
    assert (winner == 1) == (handicap < limit)
