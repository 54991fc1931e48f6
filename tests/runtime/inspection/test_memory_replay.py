"""Replay of a memory: the statistical rule, the world rebuilt from the perceived scene, and one executed contract."""

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
from dualbrain.grounding.outcome.outcome_check import check_outcome, collect_evidence
from dualbrain.memory.maintenance.contradiction import EXPECTED_AGREEMENT, SIGNIFICANCE_LEVEL
from dualbrain.records import Outcome, SceneObject
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.inspection.memory_replay import ReplayTry, compare_with_memory
from dualbrain.simulation.scenes.from_memory import scene_from_memory
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import FloorMap, KeepOutArea, check_scene
from tests.simulation.mobile_base_cell import MobileBaseCell, drive_to_action

PANDA = load_robot("panda")


@given(st.integers(1, 12), st.integers(0, 12), st.booleans())
def test_a_memory_is_only_contradicted_by_too_few_agreeing_runs(tries: int, good: int, r: bool) -> None:
    """Oracle: the binomial tail, summed here."""
    good = min(good, tries)
    runs = [ReplayTry("succeeded", 0.001, "")] * good + [ReplayTry("failed", 0.001, "")] * (tries - good)
    agreeing = good if r else tries - good
    tail = sum(
        comb(tries, k) * EXPECTED_AGREEMENT**k * (1 - EXPECTED_AGREEMENT) ** (tries - k) for k in range(agreeing + 1)
    )
    assert compare_with_memory(int(r), 0.001, runs)[1] == (tail >= SIGNIFICANCE_LEVEL)


@pytest.mark.parametrize(("Delta", "agrees"), [(0.002, True), (0.0061, False), (0.0, True), (0.0003, True)])
def test_another_delta_contradicts_a_success(Delta: float, agrees: bool) -> None:
    runs = [ReplayTry("succeeded", Delta, "")] * 5
    assert compare_with_memory(1, 0.002, runs)[1] == agrees
    assert compare_with_memory(0, 0.002, [ReplayTry("failed", Delta, "")] * 5)[1]


@pytest.mark.parametrize("choice", ["tabletop:3", "tall:4", "shelf:5", "forearm:6", "bare:0", "fragile:7"])
def test_a_remembered_world_has_the_perceived_objects(choice: str) -> None:
    spec = open_scene(choice)
    rebuilt = scene_from_memory(scene_from_spec(spec), np.random.default_rng(0), position_spread=0.003)
    check_scene(rebuilt)
    assert {obj.name for obj in rebuilt.objects} == {obj.name for obj in spec.objects}
    for obj in rebuilt.objects:
        original = spec.find(obj.name)
        assert (obj.shape, obj.role, obj.fragile_limit) == (original.shape, original.role, original.fragile_limit)
        assert np.linalg.norm(np.subtract(obj.position, original.position)) < 0.03
        assert 0.02 <= obj.mass <= 0.5
    assert rebuilt.places == spec.places


@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_a_remembered_person_continues_to_move_as_perceived(speed: float) -> None:
    perceived = scene_from_spec(open_scene("bare:0"))
    along_x = (0.5**0.5, 0.0, 0.5**0.5, 0.0)
    arm = SceneObject(
        name="forearm",
        role="person",
        shape=Capsule(0.045, 0.25),
        pose=Pose((0.7, -0.4, 0.2), along_x),
        velocity=(0.0, speed, 0.0),
    )
    rebuilt = scene_from_memory(
        msgspec.structs.replace(perceived, objects=(*perceived.objects, arm)),
        np.random.default_rng(0),
        position_spread=0.0,
    )
    assert rebuilt.mover is not None
    assert rebuilt.mover.axis == pytest.approx((1.0, 0.0, 0.0), abs=1e-9)
    assert np.subtract(rebuilt.mover.end, rebuilt.mover.start)[1] == pytest.approx(max(3.0 * speed, 0.001))
    assert (rebuilt.mover.pause > 1e5) == (speed == 0.0)


def check_placement(scene, name, destination, kind):
    grasp = Action("grasp", {"object": name})
    contract = msgspec.convert(
        {
            "id": "c-0001",
            "context": {"robot": "panda", "registry": "x" * 8},
            "action_sequence": [msgspec.to_builtins(grasp), {"skill": "place", "params": {"destination": destination}}],
        },
        Contract,
    )
    return check_contract(scene, contract, Outcome(kind=kind, reason=""))


def check_contract(after, contract, outcome):
    """The check of a given contract, without an instruction, on the scene `after`."""
    q = np.array(PANDA.home)
    before = scene_from_spec(open_scene("sorting:0" if "red_block" in after.graspable else "bare:0"))
    evidence = collect_evidence(before, after, contract, outcome, q, q, PANDA)
    return check_outcome("", outcome, contract, evidence).check


def test_perception_agrees_or_disagrees_with_the_outcome() -> None:
    scene = scene_from_spec(open_scene("bare:0"))
    bowl = scene.find("blue_bowl").pose
    moved = msgspec.structs.replace(
        scene,
        objects=tuple(
            msgspec.structs.replace(obj, pose=bowl) if obj.name == "red_cube" else obj for obj in scene.objects
        ),
    )
    assert check_placement(scene, "red_cube", "blue_bowl", "succeeded") == "disagrees"
    assert check_placement(scene, "red_cube", "blue_bowl", "failed") == "agrees"
    assert check_placement(moved, "red_cube", "blue_bowl", "succeeded") == "agrees"
    assert check_placement(moved, "red_cube", "blue_bowl", "failed") == "disagrees"
    assert check_placement(scene, "no_cube", "blue_bowl", "succeeded") == "none"
    assert check_placement(scene, "red_cube", "blue_bowl", "aborted") == "none"
    assert check_contract(scene, None, Outcome(kind="succeeded", reason="")) == "none"


@pytest.mark.parametrize(("second", "expected"), [("blue_bowl", "agrees"), ("table_left", "disagrees")])
def test_each_of_several_objects_must_be_at_its_last_destination(second: str, expected: str) -> None:
    """Cube and block are both in the bowl; the outcome agrees only if the block was placed there last."""
    scene = scene_from_spec(open_scene("sorting:0"))
    bowl = scene.find("blue_bowl").pose
    inside = tuple(msgspec.structs.replace(obj, pose=bowl) if obj.colour == "red" else obj for obj in scene.objects)
    steps = [("red_block", "table_front"), ("red_block", second), ("red_cube", "blue_bowl")]
    actions = [
        action
        for name, destination in steps
        for action in (Action("grasp", {"object": name}), Action("place", {"destination": destination}))
    ]
    contract = Contract("c-0001", Context("panda", "x" * 8), tuple(actions))
    after = msgspec.structs.replace(scene, objects=inside)
    assert check_contract(after, contract, Outcome(kind="succeeded", reason="")) == expected


def test_the_rule_gives_its_reason(tmp_path: Path) -> None:
    reason, agrees = compare_with_memory(1, 0.001, [ReplayTry("failed", None, "")] * 5)
    assert not agrees
    assert reason == "0 of 5 tries ended as remembered: too few (the probability for a true memory is 0.000)"


@pytest.mark.parametrize(
    ("choice", "robot"), [("boxes:1", "base"), ("crossing:2", "base"), ("workroom:0", "mobile_panda")]
)
def test_a_remembered_room_has_its_walls_and_furniture(choice: str, robot: str) -> None:
    spec = open_scene(choice, robot)
    spec = msgspec.structs.replace(
        spec, chart=FloorMap(spec.region, (KeepOutArea("pit", (1.2, 0.4), (0.3, 0.2), 0.7),))
    )
    rebuilt = scene_from_memory(scene_from_spec(spec), np.random.default_rng(0), position_spread=0.003)
    check_scene(rebuilt)
    assert (rebuilt.region, rebuilt.places) == (spec.region, spec.places)
    assert {(obj.name, obj.role, obj.shape) for obj in rebuilt.objects} == {
        (obj.name, obj.role, obj.shape) for obj in spec.objects
    }
    assert all(obj.fixed for obj in rebuilt.objects if obj.role in ("obstacle", "support"))
    (pit,) = rebuilt.chart.closed if rebuilt.chart else ()
    assert (pit.name, pit.middle, pit.half) == ("pit", (1.2, 0.4), (0.3, 0.2))
    assert pit.yaw == pytest.approx(0.7)


def test_a_base_drives_through_a_remembered_room() -> None:
    spec = scene_from_memory(
        scene_from_spec(open_scene("boxes:1", "base")), np.random.default_rng(0), position_spread=0.003
    )
    cell = MobileBaseCell(spec=spec)
    outcome = cell.run(drive_to_action("shelf"))
    assert outcome.kind == "succeeded", outcome.reason
    assert cell.monitor.violations() == ()
