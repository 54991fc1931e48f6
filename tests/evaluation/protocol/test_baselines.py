"""Gates of the compared methods, on the same contracts."""

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


def encode(registry, *actions, written_for=None):
    context = {"robot": "panda", "registry": written_for or registry.hash}
    return msgspec.json.encode({"id": "c-0001", "context": context, "action_sequence": list(actions)}).decode()


def check(registry, kind, *actions, written_for=None):
    data = encode(registry, *actions, written_for=written_for).encode()
    gate = BaselineGate(kind, Gate(registry, planner_grants(registry)), registry)
    header = ContractHeader(sequence=1, issued=0.0, expires=100.0, principal=PLANNER, scene_version=1)
    return gate, gate.check(data, names=NAMES, principal=PLANNER, now=1.0, header=header)


def grasp(**values):
    return {"skill": "grasp", "params": GRASP | values}


@pytest.mark.parametrize("kind", KINDS)
def test_every_gate_accepts_a_valid_contract(registry, kind):
    gate, verdict = check(registry, kind, grasp())
    assert isinstance(verdict, Accepted)
    assert verdict == gate.full_gate_verdicts[0]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("actions", [[{"skill": "grasp"}], [{"skill": "disable_filter", "params": {}}]])
def test_no_gate_accepts_a_malformed_or_unauthorized_contract(registry, kind, actions):
    _, verdict = check(registry, kind, *actions)
    assert isinstance(verdict, Rejected)
    assert verdict.stage in ("syntax", "authorization")


@pytest.mark.parametrize("kind", KINDS)
def test_every_gate_rejects_another_registry(registry, kind):
    assert check(registry, kind, grasp(), written_for="00000000")[1].stage == "authorization"


def test_numbers_out_of_bounds_are_accepted_clipped_or_rejected(registry):
    wild = grasp(speed=4.0, clearance=-0.3)
    accepted, clipped, rejected = (check(registry, kind, wild)[1] for kind in KINDS)
    assert accepted.contract.action_sequence[0].params["speed"] == 4.0
    params = clipped.contract.action_sequence[0].params
    bounds = {p.name: p for p in registry.skill("grasp").parameters}
    assert (params["speed"], params["clearance"]) == (bounds["speed"].upper, bounds["clearance"].lower)
    assert {name: params[name] for name in GRASP if name not in ("speed", "clearance")} == {
        name: value for name, value in GRASP.items() if name not in ("speed", "clearance")
    }
    assert rejected.stage == "envelope"


def test_unknown_names_pass_only_the_weakest_gate(registry):
    unknown = grasp(object="ghost")
    accepted, clipped, rejected = (check(registry, kind, unknown)[1] for kind in KINDS)
    assert isinstance(accepted, Accepted)
    assert clipped.pointer == rejected.pointer == "/action_sequence/0/params/object"


def test_the_verdict_of_the_full_gate_is_kept(registry):
    gate, verdict = check(registry, "syntax", grasp(speed=4.0))
    assert isinstance(verdict, Accepted)
    assert gate.full_gate_verdicts[0].stage == "envelope"


@pytest.mark.parametrize("kind", KINDS)
def test_an_unconstrained_answer_is_checked_without_using_the_sequence_number(registry, kind):
    """The gate accepts a sequence number once; the check of the unconstrained answer must not use it."""
    valid = encode(registry, grasp())
    for text, finish, stage in (
        (valid, STOP, ""),
        (encode(registry, grasp(speed=4.0)), STOP, "envelope"),
        ("no JSON \ud800", STOP, "syntax"),
        (valid, LENGTH, "syntax"),
    ):
        gate = BaselineGate(kind, Gate(registry, planner_grants(registry)), registry)
        gate.unconstrained_answer = Proposal(
            text=text, finish_reason=finish, planner="it", constrained_by="nothing", timings={}
        )
        headers = [
            ContractHeader(sequence=number, issued=0.0, expires=100.0, principal=PLANNER, scene_version=1)
            for number in (1, 2)
        ]
        verdicts = [gate.check(valid.encode(), names=NAMES, principal=PLANNER, now=1.0, header=one) for one in headers]
        assert all(isinstance(one, Accepted) for one in verdicts)
        assert ("" if isinstance(gate.unconstrained_verdict, Accepted) else gate.unconstrained_verdict.stage) == stage
        assert len(gate.full_gate_verdicts) == 2
