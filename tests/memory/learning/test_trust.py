"""Defences against pollution: candidates, quarantine of disputed outcomes, and daily bounds per source."""

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.errors import ConfigurationError
from dualbrain.memory.learning.trust import TrustConfig
from dualbrain.memory.maintenance.edits import release
from dualbrain.memory.memory import Memory
from dualbrain.memory.plasticity.affine_map import AffineMap
from dualbrain.memory.plasticity.hebbian_update import Plasticity
from dualbrain.memory.state.state import SECONDS_PER_DAY
from dualbrain.records import RetrievedContext
from tests.memory.memory_samples import CONFIG, NOW, REST_POSTURE, episode, grasp_contract, open_ledger, open_memory

MIDNIGHT = NOW // SECONDS_PER_DAY * SECONDS_PER_DAY


def _recall(memory: Memory, k: int = 3) -> RetrievedContext:
    return memory.retrieve("put the red cube in the bowl", "neighbour_across low", REST_POSTURE, "arm", "aaaa1111", k=k)


def _ids(recall: RetrievedContext) -> list[str]:
    return [hit.episode_id for hit in recall.exemplars]


def test_an_unconfirmed_success_is_not_retrieved_and_updates_no_weight(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("trusted"), REST_POSTURE, now=NOW)
        report = memory.store(
            episode("unconfirmed", second_opinion="none", recall=_recall(memory)), REST_POSTURE, now=NOW
        )
        assert (report.status, report.weight_updates) == ("candidate", ())
        assert "not retrieved until another outcome confirms it" in str(report)
        assert (_ids(_recall(memory)), memory.weights()) == (["trusted"], {"trusted": 0.575, "unconfirmed": 0.5})


def test_an_outcome_that_a_second_check_disputes_is_quarantined(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        for name, kind in (("a", "succeeded"), ("b", "failed")):
            report = memory.store(episode(name, kind, second_opinion="disagrees"), REST_POSTURE, now=NOW)
            assert (report.status, report.weight_updates) == ("quarantined", ())
        assert _recall(memory) == RetrievedContext()


def test_a_later_consistent_outcome_confirms_a_candidate_and_applies_its_updates(tmp_path: Path) -> None:
    """The deferred updates are applied in full, and the same ledger replays to the same weights."""
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("shown"), REST_POSTURE, now=NOW)
        memory.store(episode("unconfirmed", second_opinion="none", recall=_recall(memory)), REST_POSTURE, now=NOW)
        report = memory.store(episode("again"), REST_POSTURE, now=NOW)
        assert (report.status, report.confirmed_ids) == ("active", ("unconfirmed",))
        assert memory.weights() == pytest.approx({"shown": 0.95 * 0.575 + 0.1, "unconfirmed": 0.575, "again": 0.575})
        assert set(_ids(_recall(memory))) == {"shown", "unconfirmed", "again"}
        assert open_memory(ledger).weights() == memory.weights()


@pytest.mark.parametrize(
    ("other", "confirms"),
    [
        ({"second_opinion": "none"}, False),
        ({"second_opinion": "none", "proposer": "another planner"}, False),
        ({"second_opinion": "agrees", "proposer": "another planner"}, True),
        ({"plan": grasp_contract("green_cube")}, False),
        ({"instruction": "open the far drawer slowly", "summary": "person: crossing, overhead over_path"}, False),
        ({"registry": "bbbb2222"}, False),
    ],
)
def test_only_an_independent_and_similar_outcome_confirms(
    tmp_path: Path, other: dict[str, str], confirms: bool
) -> None:
    """Unconfirmed outcomes do not confirm each other, from one source or several: planted or wrong successes repeat."""
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("unconfirmed", second_opinion="none"), REST_POSTURE, now=NOW)
        assert (
            memory.store(episode("b", **other), REST_POSTURE, now=NOW).confirmed_ids == ("unconfirmed",)
        ) == confirms
        assert (memory.state["unconfirmed"].status == "active") == confirms


def test_a_released_candidate_updates_weights_once(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger)
        memory.store(episode("a"), REST_POSTURE, now=NOW)
        memory.store(episode("b", second_opinion="none", recall=_recall(memory)), REST_POSTURE, now=NOW)
        for _ in range(2):
            release(memory, ["b"], "seen by a person", now=NOW)
            assert memory.weights() == pytest.approx({"a": 0.95 * 0.575 + 0.1, "b": 0.575})


@settings(max_examples=6, deadline=None)
@given(st.lists(st.sampled_from(("succeeded", "failed")), min_size=8, max_size=25), st.floats(0.05, 0.3))
def test_one_source_changes_weights_within_the_daily_bounds(
    tmp_path_factory: pytest.TempPathFactory, kinds: list[str], bound: float
) -> None:
    """Law over any sequence: Σ|Δw| by one source in one day stays below both bounds; the next day starts at zero."""
    trust = TrustConfig(max_change_per_memory=bound, max_change_per_source=1.5 * bound)
    with open_ledger(tmp_path_factory.mktemp("l")) as ledger:
        memory = open_memory(ledger, replace(CONFIG, trust=trust, plasticity=Plasticity()))
        for name in ("a", "b"):
            memory.store(episode(name, proposer="founder"), REST_POSTURE, now=MIDNIGHT)
        start, moved = memory.weights(), {"a": 0.0, "b": 0.0}
        for i, kind in enumerate(kinds):
            shown = RetrievedContext(tuple(hit for hit in _recall(memory, 9).exemplars if hit.episode_id in start))
            before = memory.weights()
            memory.store(episode(f"e-{i}", kind, recall=shown, proposer="mallory"), REST_POSTURE, now=MIDNIGHT + i)
            for name in moved:
                moved[name] += abs(memory.weights()[name] - before[name])
        assert max(moved.values()) <= bound + 1e-9
        assert memory.state.influence.total["mallory"] <= 1.5 * bound + 1e-9
        shown = RetrievedContext(tuple(hit for hit in _recall(memory, 99).exemplars if hit.episode_id in start))
        tomorrow = episode("tomorrow", "failed", recall=shown, proposer="mallory")
        change = memory.store(tomorrow, REST_POSTURE, now=MIDNIGHT + SECONDS_PER_DAY).weight_updates[1]
        assert change.share == min(1.0, bound / abs(0.95 * change.before - 0.1 - change.before))


def test_outcomes_of_an_earlier_day_count_on_the_newest_day(tmp_path: Path) -> None:
    """A slow clock, or episodes that waited for a server, do not switch the bound off."""
    bound = 0.15
    trust = TrustConfig(max_change_per_memory=bound)
    with open_ledger(tmp_path) as ledger:
        memory = open_memory(ledger, replace(CONFIG, trust=trust))
        memory.store(episode("a", proposer="founder"), REST_POSTURE, now=MIDNIGHT)
        shown, start = _recall(memory), memory.weights()["a"]
        for i, days in enumerate((0, 1, 1, 2, 1)):  # before midnight of the newest day
            late = episode(f"e-{i}", "failed", recall=shown, proposer="mallory")
            memory.store(late, REST_POSTURE, now=MIDNIGHT - days * SECONDS_PER_DAY)
        assert start - memory.weights()["a"] == pytest.approx(bound)
        assert memory.state.influence == open_memory(ledger, memory.config).state.influence


@given(st.floats(0, 1), st.floats(0.5, 1), st.floats(-1, 1), st.floats(0, 2), st.floats(0, 2))
def test_a_limited_update_stays_within_the_budget(
    w: float, gain: float, offset: float, total: float, single: float
) -> None:
    trust = TrustConfig(max_change_per_source=1.0, max_change_per_memory=0.5)
    update, share = trust.limit_update(AffineMap(gain, offset), w, (total, single))
    budget = max(0.0, min(1.0 - total, 0.5 - single))
    assert abs(update(w) - w) <= budget + 1e-12
    assert 0.0 <= share <= 1.0


@pytest.mark.parametrize(
    "setting", [{"max_change_per_source": 0.0}, {"max_change_per_memory": -1.0}, {"min_similarity": 2.0}]
)
def test_invalid_bounds_are_refused(setting: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError, match="trust"):
        TrustConfig(**setting)
