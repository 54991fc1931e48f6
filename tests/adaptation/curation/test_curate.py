"""D_clean: which episodes are selected, merged and repeated, and that no scene is on both sides of the split."""

import json
from itertools import combinations

import msgspec
import numpy as np
import pytest

from dualbrain.adaptation.curation.balancing import compute_repeats, sample_attributes
from dualbrain.adaptation.curation.candidate import read_candidates
from dualbrain.adaptation.curation.curate import CurationConfig, curate
from dualbrain.adaptation.curation.deduplication import merge_duplicates
from dualbrain.adaptation.curation.scene_split import choose_held_out_groups, group_scenes
from dualbrain.adaptation.curation.selection import CleanRules
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.verdict import Accepted
from dualbrain.errors import ConfigurationError
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader
from dualbrain.memory.maintenance.compaction import compact_in_place
from dualbrain.memory.maintenance.edits import forget, quarantine, release
from dualbrain.memory.memory import Memory
from dualbrain.memory.plasticity.plan_similarity import same_plan
from tests.adaptation.sample_episodes import (
    CONFIG,
    NOW,
    REGISTRY,
    distinct_episodes,
    episode,
    pick_contract,
    scene,
    summary,
    write_ledger,
)

GOOD = "good"
ALL = CurationConfig(held_out=0.0)

REASONS = {
    "outcome failed": {"kind": "failed"},
    "outcome taken_over": {"kind": "taken_over"},
    "outcome paused": {"kind": "paused"},
    "outcome slowed": {"kind": "slowed"},
    "outcome handed_over": {"kind": "handed_over"},
    "outcome aborted": {"kind": "aborted"},
    "outcome emergency": {"kind": "emergency"},
    "outcome declined": {"kind": "declined"},
    "quarantined in memory": {"second_opinion": "disagrees"},
    "candidate in memory": {"second_opinion": "none", "proposer": "another"},
    "of another robot": {"robot": "ur5e"},
    "of another registry": {"registry": "00000000"},
    "executed without the safety filter": {"versions": {"filter": "off"}},
    "without an instruction": {"instruction": " "},
    "Δ above 0.003": {"Delta": 0.0031},
    "refused by the gate: envelope": {"plan": pick_contract(force=900.0)},
    "slower than 1.5 times the median of its family": {"duration": 15.1},
}


@pytest.mark.parametrize(("reason", "change"), REASONS.items(), ids=REASONS)
def test_each_reason_alone_excludes(tmp_path, reason, change):
    others = [episode(GOOD, scene_summary=summary(number=1)), episode("also good", scene_summary=summary(number=2))]
    bad = episode(
        "bad",
        scene_summary=summary(number=3, symbols="path_max_height tall"),
        **{"instruction": "another thing", **change},
    )
    with write_ledger(tmp_path, [*others, bad]) as ledger:
        found = curate(ledger, REGISTRY, ALL)
    assert found.left_out == {reason: ("bad",)}
    assert {row.memory for row in found.train} == {GOOD, "also good"}


def test_of_a_shared_ledger_only_episodes_of_usable_robots_are_selected(tmp_path, monkeypatch):
    path, episodes = tmp_path / "ledger.sqlite", distinct_episodes(2)
    with Ledger(path, holder="a test", now=NOW) as ledger:
        memory = Memory(ledger, HashingEncoder(32), CONFIG)
        for writer, one in zip(("one", "two"), episodes, strict=True):
            ledger.start_run(f"{writer}/run", {}, now=NOW)
            memory.store(one, Posture((0.0,), 0.04), now=NOW)
            ledger.end_run({}, now=NOW)
    with LedgerReader(path) as ledger:
        assert {row.memory for row in curate(ledger, REGISTRY, ALL).train} == {"e0", "e1"}
        monkeypatch.setattr(LedgerReader, "usable_writers", ("two",))
        found = curate(ledger, REGISTRY, ALL)
    assert {row.memory for row in found.train} == {"e1"}
    assert found.left_out == {"of a robot that use_memories_of does not name": ("e0",)}


def narrowed(most):
    """The vocabulary of a site where nothing grips harder than `most` [N]."""
    skills = [
        msgspec.structs.replace(
            skill,
            parameters=tuple(
                msgspec.structs.replace(one, upper=most) if one.name == "force" else one for one in skill.parameters
            ),
        )
        for skill in REGISTRY.skills
    ]
    return SkillRegistry(REGISTRY.robot, tuple(skills))


def test_episodes_at_a_site_are_selected_in_the_robots_vocabulary_if_the_site_gate_accepts_them(tmp_path):
    site = narrowed(20.0)
    there = episode("there", registry=site.hash, scene_summary=summary(number=3), instruction="take it away")
    hard = episode("hard", plan=pick_contract(force=21.0), scene_summary=summary(number=4), instruction="grip it")
    with write_ledger(tmp_path, [*distinct_episodes(2), there, hard]) as ledger:
        without, found = curate(ledger, REGISTRY, ALL), curate(ledger, REGISTRY, ALL, site=site)
        with pytest.raises(ConfigurationError, match="vocabulary of the site"):
            curate(ledger, site, ALL, site=REGISTRY)
    assert without.left_out == {"of another registry": ("there",)}
    assert found.left_out == {"refused by the gate: envelope": ("hard",)}
    rows = {row.memory: row for row in found.train}
    assert rows.keys() == {"e0", "e1", "there"}
    assert all(site.hash not in json.dumps([row.prompt, row.completion]) for row in rows.values())
    assert [rows[name] for name in ("e0", "e1")] == [row for row in without.train if row.memory in ("e0", "e1")]


def test_an_episode_at_the_limits_is_selected(tmp_path):
    edge = episode("edge", Delta=0.003, duration=15.0, scene_summary=summary(number=3))
    with write_ledger(tmp_path, [*distinct_episodes(2), edge]) as ledger:
        assert "edge" in {row.memory for row in curate(ledger, REGISTRY, ALL).train}


def test_a_success_without_a_control_tick_is_selected(tmp_path):
    """`home` from the home pose has no Δ."""
    with write_ledger(
        tmp_path, [*distinct_episodes(2), episode("there", Delta=None, duration=0.0, scene_summary=summary(number=3))]
    ) as ledger:
        assert "there" in {row.memory for row in curate(ledger, REGISTRY, ALL).train}


def test_only_a_decline_that_is_named_and_accepted_by_the_gate_is_selected(tmp_path):
    """A decline has neither success nor Δ. Naming a failure, or a decline that the gate rejects, does not select it."""
    plan = pick_contract() | {"action_sequence": [{"skill": "decline", "params": {"reason": "no skill can do this"}}]}
    wrong = pick_contract() | {"action_sequence": [{"skill": "decline", "params": {"reason": "no" * 200}}]}
    refusals = [
        episode(
            name,
            "declined",
            Delta=None,
            duration=0.0,
            plan=contract,
            scene_summary=summary(number=9 + i),
            instruction=f"jump {name}",
        )
        for i, (name, contract) in enumerate({"right": plan, "unnamed": plan, "endless": wrong}.items())
    ]
    with write_ledger(
        tmp_path, [*distinct_episodes(2), *refusals, episode("bad", "failed", scene_summary=summary(number=8))]
    ) as ledger:
        found = curate(ledger, REGISTRY, ALL, declines={"right", "endless", "bad"})
    assert {row.memory for row in found.train} == {"e0", "e1", "right"}
    assert found.left_out == {
        "outcome declined": ("unnamed",),
        "outcome failed": ("bad",),
        "refused by the gate: envelope": ("endless",),
    }


def test_without_physical_selection_all_valid_contracts_are_selected(tmp_path):
    """The ablation of paper 7.4: independent of the outcome, except for rejected contracts and quarantined memories."""
    kinds = {
        "good": {},
        "rough": {"Delta": 0.5},
        "slow": {"duration": 90.0},
        "failed": {"kind": "failed"},
        "unconfirmed": {"second_opinion": "none", "proposer": "another"},
        "endless": {"plan": pick_contract(force=900.0)},
    }
    episodes = [
        episode(name, scene_summary=summary(number=number), instruction=f"do {name}", **change)
        for number, (name, change) in enumerate(kinds.items())
    ]
    every = CurationConfig(CleanRules(physical=False), held_out=0.0)
    with write_ledger(tmp_path, episodes) as ledger:
        found, clean = curate(ledger, REGISTRY, every), curate(ledger, REGISTRY, ALL)
    assert {row.memory for row in found.train} == {"good", "rough", "slow", "failed", "unconfirmed"}
    assert found.left_out == {"refused by the gate: envelope": ("endless",)}
    assert {row.memory for row in clean.train} < {row.memory for row in found.train}


def test_quarantined_and_forgotten_memories_are_excluded_and_released_ones_selected(tmp_path):
    def quarantine_and_forget(memory):
        quarantine(memory, ["e0", "e1"], "a test", now=NOW)
        release(memory, ["e1"], "a test", now=NOW)
        forget(memory, ["e2"], "a test", now=NOW)

    with write_ledger(tmp_path, distinct_episodes(4), quarantine_and_forget) as ledger:
        found = curate(ledger, REGISTRY, ALL)
    assert {row.memory for row in found.train} == {"e1", "e3"}
    assert found.left_out == {"quarantined in memory": ("e0",), "forgotten in memory": ("e2",)}


def test_an_empty_selection_is_an_error_with_the_reasons(tmp_path):
    with (
        write_ledger(tmp_path, [episode("bad", "failed")]) as ledger,
        pytest.raises(ConfigurationError, match="1 outcome failed"),
    ):
        curate(ledger, REGISTRY, ALL)
    (tmp_path / "empty").mkdir()
    with write_ledger(tmp_path / "empty", []) as ledger, pytest.raises(ConfigurationError, match="none of 0 memories"):
        curate(ledger, REGISTRY, ALL)


def test_every_sample_names_its_events_and_passes_the_gate(tmp_path):
    odd = pick_contract(id="c-0002", force=20)
    odd["action_sequence"][0]["params"] = dict(reversed(odd["action_sequence"][0]["params"].items()))
    with write_ledger(
        tmp_path, [*distinct_episodes(5), episode("odd", plan=odd, scene_summary=summary(number=9))]
    ) as ledger:
        found = curate(ledger, REGISTRY, ALL)
        for row in found.train:
            assert ledger.event(row.events[0]).subject == row.memory
            gate = Gate(REGISTRY, {"planner": frozenset(REGISTRY.by_name)})
            verdict = gate.check(row.contract.encode(), names=row.scene_names, principal="planner", now=0.0)
            assert isinstance(verdict, Accepted)
            assert [turn["role"] for turn in row.prompt] == ["system", "user"]
            assert [turn["role"] for turn in row.completion] == ["assistant"]
            assert list(json.loads(row.contract)) == ["id", "context", "action_sequence"]
            names = [p.name for p in REGISTRY.skill("grasp").parameters]
            assert list(json.loads(row.contract)["action_sequence"][0]["params"]) == names
            assert json.loads(row.contract)["id"] == "c-0001"


def test_near_duplicates_are_merged_into_the_one_with_the_least_intervention(tmp_path):
    same = [
        episode("worse", Delta=0.002),
        episode("best", Delta=0.0005, instruction="Put the  red cube in the bowl", plan=pick_contract(force=15.5)),
        episode("again", Delta=0.0005),
        episode("other plan", plan=pick_contract(force=30.0)),
        episode("other words", instruction="bring the red cube to the bowl"),
    ]
    with write_ledger(tmp_path, same) as ledger:
        found, rows = curate(ledger, REGISTRY, ALL), list(read_candidates(ledger))
    assert {row.memory: len(row.events) for row in found.train} == {"best": 3, "other plan": 1, "other words": 1}
    assert found.merged == 2
    kept = [pair.representative for pair in merge_duplicates(rows)]
    questions = [(one.summary, " ".join(one.instruction.lower().split()), one.contract) for one in kept]
    for one, other in combinations(questions, 2):
        assert one[:2] != other[:2] or not same_plan(*(msgspec.to_builtins(side[2]) for side in (one, other)))


def test_a_rarer_sample_is_never_repeated_less_and_none_is_lost(tmp_path):
    common = [episode(f"c{i}", scene_summary=summary(number=i)) for i in range(30)]
    rare = [
        episode(
            f"r{i}",
            scene_summary=summary("near_edge, path_max_height none", number=100 + i),
            plan=pick_contract(speed=0.1),
        )
        for i in range(3)
    ]
    single = [episode("one", scene_summary=summary(number=999), plan=pick_contract(approach="tilted"))]
    with write_ledger(tmp_path, [*common, *rare, *single]) as ledger:
        rows = list(read_candidates(ledger))
    shown = compute_repeats(rows, REGISTRY, max_repeats=4)
    assert len(shown) == len(rows)
    assert shown[:30] == [1] * 30
    assert shown[30:33] == [3, 3, 3]
    assert shown[33] == 4
    tables = [sample_attributes(row, REGISTRY) for row in rows]
    rarity = [min(sum(a in table for table in tables) for a in own) for own in tables]
    for i, j in combinations(range(len(rows)), 2):
        assert (rarity[i] - rarity[j]) * (shown[j] - shown[i]) >= 0
    assert "grasp.approach=tilted" in tables[33]
    assert not any("red_cube" in attribute for attribute in tables[33])


def test_no_scene_and_no_question_is_on_both_sides(tmp_path):
    """25 scenes, each seen three times with noise; compared pair by pair."""
    rng = np.random.default_rng(0)
    places = rng.uniform((0.3, -0.4), (0.7, 0.4), (25, 2))
    episodes = [
        episode(
            f"e{i}",
            perceived_scene=scene(x=float(x + rng.uniform(-0.004, 0.004)), y=float(y + rng.uniform(-0.004, 0.004))),
            scene_summary=summary(number=int(rng.integers(60))),
            instruction=f"words {i}",
        )
        for i, (x, y) in enumerate(np.repeat(places, 3, axis=0))
    ]
    with write_ledger(tmp_path, episodes) as ledger:
        found, rows = (
            curate(ledger, REGISTRY, CurationConfig(held_out=0.3)),
            {c.memory.id: c for c in read_candidates(ledger)},
        )
    assert found.train
    assert found.held_out
    for one in found.train:
        for other in found.held_out:
            assert int(one.memory[1:]) // 3 != int(other.memory[1:]) // 3
            assert rows[one.memory].summary != rows[other.memory].summary


def test_a_scene_keeps_its_side_when_others_are_added(tmp_path):
    (tmp_path / "later").mkdir()
    with write_ledger(tmp_path, distinct_episodes(12)) as ledger:
        before = {row.memory for row in curate(ledger, REGISTRY, CurationConfig(held_out=0.3)).held_out}
    with write_ledger(tmp_path / "later", distinct_episodes(16)) as ledger:
        after = {row.memory for row in curate(ledger, REGISTRY, CurationConfig(held_out=0.3)).held_out}
    assert before
    assert before == {name for name in after if int(name[1:]) < 12}


def test_a_scene_keeps_its_side_when_it_is_repeated_and_when_the_ledger_is_compacted(tmp_path):
    """The repetition is selected for its smaller Δ; the oldest episode may not be selected at all."""

    def scenes(**same):
        return [msgspec.structs.replace(one, **same) for one in distinct_episodes(30)]

    first = [
        msgspec.structs.replace(one, outcome=msgspec.structs.replace(one.outcome, Delta=0.002 if i % 2 else 0.9))
        for i, one in enumerate(scenes())
    ]
    better = [
        msgspec.structs.replace(one, id=f"x{one.id}", outcome=msgspec.structs.replace(one.outcome, Delta=0.0005))
        for one in scenes()
    ]
    sides = []
    for folder, episodes in (("first", first), ("later", [*first, *better])):
        (tmp_path / folder).mkdir()
        with write_ledger(tmp_path / folder, episodes) as ledger:
            sides.append(sides_of(curate(ledger, REGISTRY, CurationConfig(held_out=0.3))))
    path = tmp_path / "later" / "ledger.sqlite"
    compact_in_place(path, holder="a test", now=NOW, timeout_s=1.0)
    with LedgerReader(path) as ledger:
        sides.append(sides_of(curate(ledger, REGISTRY, CurationConfig(held_out=0.3))))
    earlier, later, compacted = sides
    assert len(later) == 30
    assert earlier.items() <= later.items()
    assert compacted == later


def sides_of(found):
    """By place: whether it is held out."""
    rows = [(row, row in found.held_out) for row in (*found.train, *found.held_out)]
    return {row.memory.removeprefix("x"): is_held_out for row, is_held_out in rows}


@pytest.mark.parametrize("salt", list("abcdefghijklmnop"))
def test_the_most_frequent_task_is_used_for_training_for_every_salt(salt):
    groups = ["often"] * 21 + [f"g{i}" for i in range(79)]
    assert "often" not in choose_held_out_groups(groups, 0.2, salt)
    assert choose_held_out_groups(groups, 0.2, salt) == choose_held_out_groups([*groups[21:], "often"], 0.2, salt) - {
        "often"
    }
    assert (
        len(choose_held_out_groups(["a", "a", "b"], 0.2, salt)) == 1
    )  # where each is that large, one is held out all the same


def test_at_least_one_scene_is_held_out_and_never_all():
    assert choose_held_out_groups(["a"], 0.2, "s") == frozenset()
    assert choose_held_out_groups(["a", "b"], 0.0, "s") == frozenset()
    for salt in "abcdef":
        for share in (1e-9, 0.5, 0.999):
            assert 1 <= len(choose_held_out_groups(["a", "b", "c", "a"], share, salt)) <= 2


def test_different_objects_make_another_scene(tmp_path):
    pair = [
        episode("a", scene_summary=summary(number=1)),
        episode("b", scene_summary=summary(number=2), perceived_scene=scene(other="green_cube")),
        episode("c", scene_summary=summary(number=3), perceived_scene=scene(x=0.51)),
    ]
    with write_ledger(tmp_path, pair) as ledger:
        groups = group_scenes(list(read_candidates(ledger)))
    assert groups[0] == groups[2] != groups[1]


def test_settings_out_of_range_are_rejected():
    for make in (
        lambda: CleanRules(epsilon=-1.0),
        lambda: CleanRules(epsilon=float("nan")),
        lambda: CleanRules(slowest=0.5),
        lambda: CurationConfig(held_out=1.0),
        lambda: CurationConfig(most_repeats=0),
    ):
        with pytest.raises(ConfigurationError):
            make()
