"""What each method's door lets through, on the same bytes."""

import msgspec
import pytest

from dualbrain.contracts.contract import ContractHeader
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Accepted, Rejected
from dualbrain.evaluation.protocol.baselines import BaselineGate
from dualbrain.grounding.vocabulary import load_skill_registry, planner_grants
from dualbrain.planner.protocol import LENGTH, STOP
from dualbrain.records import Proposal

NAMES = SceneNames(("red_cube",), ("blue_bowl",), 1)
GRASP = {
    "object": "red_cube",
    "speed": 0.2,
    "clearance": 0.15,
    "finger_axis": "along",
    "opening": 0.08,
    "approach": "top",
    "wait": "none",
    "force": 12.0,
}
KINDS = ("syntax", "clip", "gate")


@pytest.fixture(scope="module")
def registry():
    return load_skill_registry("panda")


def written(registry, *actions, written_for=None):
    about = {"robot": "panda", "registry": written_for or registry.hash}
    return msgspec.json.encode({"id": "c-0001", "context": about, "action_sequence": list(actions)}).decode()


def check(registry, kind, *actions, written_for=None):
    data = written(registry, *actions, written_for=written_for).encode()
    door = BaselineGate(kind, Gate(registry, planner_grants(registry)), registry)
    stamp = ContractHeader(sequence=1, issued=0.0, expires=100.0, principal=PLANNER, scene_version=1)
    return door, door.check(data, names=NAMES, principal=PLANNER, now=1.0, header=stamp)


def grasp(**values):
    return {"skill": "grasp", "params": GRASP | values}


@pytest.mark.parametrize("kind", KINDS)
def test_a_good_contract_passes_every_door_the_same(registry, kind):
    door, verdict = check(registry, kind, grasp())
    assert isinstance(verdict, Accepted)
    assert verdict == door.full_gate_verdicts[0]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("actions", [[{"skill": "grasp"}], [{"skill": "disable_filter", "params": {}}]])
def test_no_door_lets_in_what_is_malformed_or_not_authorized(registry, kind, actions):
    _, verdict = check(registry, kind, *actions)
    assert isinstance(verdict, Rejected)
    assert verdict.stage in ("syntax", "authorization")


@pytest.mark.parametrize("kind", KINDS)
def test_another_vocabulary_is_refused_at_every_door(registry, kind):
    assert check(registry, kind, grasp(), written_for="00000000")[1].stage == "authorization"


def test_numbers_out_of_bounds_are_taken_clipped_or_refused(registry):
    wild = grasp(speed=4.0, clearance=-0.3)
    taken, clipped, refused = (check(registry, kind, wild)[1] for kind in KINDS)
    assert taken.contract.action_sequence[0].params["speed"] == 4.0
    params = clipped.contract.action_sequence[0].params
    bounds = {p.name: p for p in registry.skill("grasp").parameters}
    assert (params["speed"], params["clearance"]) == (bounds["speed"].upper, bounds["clearance"].lower)
    assert {name: params[name] for name in GRASP if name not in ("speed", "clearance")} == {
        name: value for name, value in GRASP.items() if name not in ("speed", "clearance")
    }
    assert refused.stage == "envelope"


def test_names_that_are_not_offered_pass_only_the_weakest_door(registry):
    phantom = grasp(object="ghost")
    taken, intercepted, refused = (check(registry, kind, phantom)[1] for kind in KINDS)
    assert isinstance(taken, Accepted)
    assert intercepted.pointer == refused.pointer == "/action_sequence/0/params/object"


def test_the_whole_gates_word_is_kept_whatever_the_door_says(registry):
    door, verdict = check(registry, "syntax", grasp(speed=4.0))
    assert isinstance(verdict, Accepted)
    assert door.full_gate_verdicts[0].stage == "envelope"


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_put_aside_is_judged_by_the_whole_gate_and_takes_nothing_from_the_proposal(registry, kind):
    """The gate accepts a sequence number once: what is only looked at must not use it up."""
    good = written(registry, grasp())
    for text, finish, stage in (
        (good, STOP, ""),
        (written(registry, grasp(speed=4.0)), STOP, "envelope"),
        ("no JSON \ud800", STOP, "syntax"),
        (good, LENGTH, "syntax"),
    ):
        door = BaselineGate(kind, Gate(registry, planner_grants(registry)), registry)
        door.unconstrained_answer = Proposal(
            text=text, finish_reason=finish, planner="it", constrained_by="nothing", timings={}
        )
        stamps = [
            ContractHeader(sequence=number, issued=0.0, expires=100.0, principal=PLANNER, scene_version=1)
            for number in (1, 2)
        ]
        verdicts = [door.check(good.encode(), names=NAMES, principal=PLANNER, now=1.0, header=one) for one in stamps]
        assert all(isinstance(one, Accepted) for one in verdicts)
        assert ("" if isinstance(door.unconstrained_verdict, Accepted) else door.unconstrained_verdict.stage) == stage
        assert len(door.full_gate_verdicts) == 2
