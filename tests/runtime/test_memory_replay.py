"""Replaying a memory: the statistical rule, the world rebuilt from what was perceived, and one contract tried again."""

from math import comb
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.core.geometry.shapes import Capsule, Pose
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.grounding.outcome_check import check_outcome
from dualbrain.memory.maintenance.contradiction import EXPECTED_AGREEMENT, SIGNIFICANCE_LEVEL
from dualbrain.records import Outcome, SceneObject
from dualbrain.runtime.inspection.memory_replay import ReplayTry, compare_with_memory
from dualbrain.simulation.scenes.from_memory import scene_from_memory
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import FloorMap, KeepOutArea, check_scene
from tests.simulation.mobile_base_cell import MobileBaseCell, drive_to_action


@given(st.integers(1, 12), st.integers(0, 12), st.booleans())
def test_a_memory_is_contradicted_by_too_few_repetitions_only(tries: int, good: int, r: bool) -> None:
    """Oracle: the binomial tail, summed here."""
    good = min(good, tries)
    done = [ReplayTry("succeeded", 0.001, "")] * good + [ReplayTry("failed", 0.001, "")] * (tries - good)
    agreeing = good if r else tries - good
    tail = sum(
        comb(tries, k) * EXPECTED_AGREEMENT**k * (1 - EXPECTED_AGREEMENT) ** (tries - k) for k in range(agreeing + 1)
    )
    assert compare_with_memory(int(r), 0.001, done)[1] == (tail >= SIGNIFICANCE_LEVEL)


@pytest.mark.parametrize(("Delta", "agrees"), [(0.002, True), (0.0061, False), (0.0, True), (0.0003, True)])
def test_another_delta_contradicts_a_success(Delta: float, agrees: bool) -> None:
    done = [ReplayTry("succeeded", Delta, "")] * 5
    assert compare_with_memory(1, 0.002, done)[1] == agrees
    assert compare_with_memory(0, 0.002, [ReplayTry("failed", Delta, "")] * 5)[1]


@pytest.mark.parametrize("choice", ["tabletop:3", "tall:4", "shelf:5", "forearm:6", "bare:0", "fragile:7"])
def test_a_remembered_world_is_what_was_perceived(choice: str) -> None:
    spec = open_scene(choice)
    again = scene_from_memory(scene_from_spec(spec), np.random.default_rng(0), position_spread=0.003)
    check_scene(again)
    assert {thing.name for thing in again.objects} == {thing.name for thing in spec.objects}
    for thing in again.objects:
        was = spec.find(thing.name)
        assert (thing.shape, thing.role, thing.fragile_limit) == (was.shape, was.role, was.fragile_limit)
        assert np.linalg.norm(np.subtract(thing.position, was.position)) < 0.03
        assert 0.02 <= thing.mass <= 0.5
    assert again.places == spec.places


@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_a_remembered_person_goes_on_as_perceived(speed: float) -> None:
    seen = scene_from_spec(open_scene("bare:0"))
    along_x = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
    arm = SceneObject(
        name="forearm",
        role="person",
        shape=Capsule(0.045, 0.25),
        pose=Pose((0.7, -0.4, 0.2), along_x),
        velocity=(0.0, speed, 0.0),
    )
    again = scene_from_memory(
        msgspec.structs.replace(seen, objects=(*seen.objects, arm)), np.random.default_rng(0), position_spread=0.0
    )
    assert again.mover is not None
    assert again.mover.axis == pytest.approx((1.0, 0.0, 0.0), abs=1e-9)
    assert np.subtract(again.mover.end, again.mover.start)[1] == pytest.approx(max(3.0 * speed, 0.001))
    assert (again.mover.pause > 1e5) == (speed == 0.0)


def _told(scene, thing, where, kind):
    grasp = Action("grasp", {"object": thing})
    contract = msgspec.convert(
        {
            "id": "c-0001",
            "context": {"robot": "panda", "registry": "x" * 8},
            "action_sequence": [msgspec.to_builtins(grasp), {"skill": "place", "params": {"destination": where}}],
        },
        Contract,
    )
    return check_outcome(scene, contract, Outcome(kind=kind, reason=""))


def test_the_eyes_agree_or_disagree_with_the_skills() -> None:
    scene = scene_from_spec(open_scene("bare:0"))
    bowl = scene.find("blue_bowl").pose
    moved = msgspec.structs.replace(
        scene,
        objects=tuple(
            msgspec.structs.replace(thing, pose=bowl) if thing.name == "red_cube" else thing for thing in scene.objects
        ),
    )
    assert _told(scene, "red_cube", "blue_bowl", "succeeded") == "disagrees"
    assert _told(scene, "red_cube", "blue_bowl", "failed") == "agrees"
    assert _told(moved, "red_cube", "blue_bowl", "succeeded") == "agrees"
    assert _told(moved, "red_cube", "blue_bowl", "failed") == "disagrees"
    assert _told(scene, "no_cube", "blue_bowl", "succeeded") == "none"
    assert _told(scene, "red_cube", "blue_bowl", "aborted") == "none"
    assert check_outcome(scene, None, Outcome(kind="succeeded", reason="")) == "none"


@pytest.mark.parametrize(("second", "word"), [("blue_bowl", "agrees"), ("table_left", "disagrees")])
def test_of_several_things_each_must_be_where_it_was_placed_last(second: str, word: str) -> None:
    """Each names a thing and where; the cube is in the bowl all the time, the block only if that was asked."""
    scene = scene_from_spec(open_scene("sorting:0"))
    bowl = scene.find("blue_bowl").pose
    inside = tuple(
        msgspec.structs.replace(thing, pose=bowl) if thing.colour == "red" else thing for thing in scene.objects
    )
    steps = [("red_block", "table_front"), ("red_block", second), ("red_cube", "blue_bowl")]
    actions = [
        action
        for thing, where in steps
        for action in (Action("grasp", {"object": thing}), Action("place", {"destination": where}))
    ]
    contract = Contract("c-0001", Context("panda", "x" * 8), tuple(actions))
    after = msgspec.structs.replace(scene, objects=inside)
    assert check_outcome(after, contract, Outcome(kind="succeeded", reason="")) == word


def test_the_rule_is_told_in_words(tmp_path: Path) -> None:
    words, agrees = compare_with_memory(1, 0.001, [ReplayTry("failed", None, "")] * 5)
    assert not agrees
    assert words == "0 of 5 tries ended as remembered: too few (a true memory would show that with chance 0.000)"


@pytest.mark.parametrize(
    ("choice", "robot"), [("boxes:1", "base"), ("crossing:2", "base"), ("workroom:0", "mobile_panda")]
)
def test_a_remembered_room_has_its_walls_and_what_stands_in_it(choice: str, robot: str) -> None:
    spec = open_scene(choice, robot)
    spec = msgspec.structs.replace(
        spec, chart=FloorMap(spec.region, (KeepOutArea("pit", (1.2, 0.4), (0.3, 0.2), 0.7),))
    )
    again = scene_from_memory(scene_from_spec(spec), np.random.default_rng(0), position_spread=0.003)
    check_scene(again)
    assert (again.region, again.places) == (spec.region, spec.places)
    assert {(thing.name, thing.role, thing.shape) for thing in again.objects} == {
        (thing.name, thing.role, thing.shape) for thing in spec.objects
    }
    assert all(thing.fixed for thing in again.objects if thing.role in ("obstacle", "support"))
    (pit,) = again.chart.closed if again.chart else ()
    assert (pit.name, pit.middle, pit.half) == ("pit", (1.2, 0.4), (0.3, 0.2))
    assert pit.yaw == pytest.approx(0.7)


def test_a_base_drives_through_a_remembered_room_as_it_did() -> None:
    spec = scene_from_memory(
        scene_from_spec(open_scene("boxes:1", "base")), np.random.default_rng(0), position_spread=0.003
    )
    hall = MobileBaseCell(spec=spec)
    outcome = hall.run(drive_to_action("shelf"))
    assert outcome.kind == "succeeded", outcome.reason
    assert hall.monitor.violations() == ()
