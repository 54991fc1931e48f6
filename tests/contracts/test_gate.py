"""The gate accepts exactly the contracts that its registry, grants and scene allow, and each stage can refuse alone."""

import copy
import gc
import json
import time
from typing import Any

import jsonschema
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dualbrain.contracts.contract import Contract, ContractHeader
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.gate.syntax import SyntaxStage, _error_order, _rejection
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.schema import syntax_schema, validation_schema
from dualbrain.contracts.verdict import Accepted, Rejected
from dualbrain.errors import UnknownNameError
from tests.contracts.contract_strategies import (
    NAMES,
    PRINCIPAL,
    REGISTRY,
    build_registry,
    check_document,
    contract_strategy,
    unrestricted_gate,
)
from tests.contracts.mutations import MUTATIONS

GATE = unrestricted_gate()
CONJUNCTION = jsonschema.Draft7Validator(validation_schema(REGISTRY, NAMES))
SYNTAX = jsonschema.Draft7Validator(syntax_schema(REGISTRY))
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**14), 10**14) | st.floats(-1e9, 1e9) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=6), inner, max_size=4),
    max_leaves=12,
)
GOOD: dict[str, Any] = {
    "id": "c-0007",
    "context": {"robot": "panda", "registry": REGISTRY.hash},
    "action_sequence": [
        {"skill": "home", "params": {"speed": 0.1}},
        {"skill": "decline", "params": {"reason": "the bowl is not in the scene"}},
    ],
}


def with_(path: tuple[str | int, ...], value: Any) -> dict[str, Any]:
    """`GOOD` with one place changed."""
    document = copy.deepcopy(GOOD)
    owner: Any = document
    for key in path[:-1]:
        owner = owner[key]
    owner[path[-1]] = value
    return document


HIDDEN_KINDS = (
    "\u00ad\u034f\u061c\u115f\u1160\u17b4\u180b\u180e\u200b\u202e\u2065\u2800\u3164\ue000\ufdd0\ufe00\ufe0f\uffa0"
    "\ufff9\U0001d173\U000e0001\U000e0041\U000e0100\U000e01ef\U000f0000\U0010ffff\u0378"
)


@pytest.mark.parametrize("character", HIDDEN_KINDS, ids=lambda one: f"{ord(one):04x}")
def test_a_text_with_a_hidden_character_is_rejected(character: str) -> None:
    document = with_(("action_sequence", 1, "params", "reason"), f"the bowl{character} is away")
    verdict = check_document(GATE, document)
    assert isinstance(verdict, Rejected)
    assert (verdict.stage, verdict.pointer) == ("envelope", "/action_sequence/1/params/reason")
    assert not CONJUNCTION.is_valid(document)


@settings(max_examples=60, deadline=None)
@given(contract_strategy())
def test_a_contract_that_follows_from_the_specs_is_accepted_unchanged(document: dict[str, Any]) -> None:
    verdict = check_document(GATE, document)
    assert isinstance(verdict, Accepted)
    contract = verdict.contract
    assert (contract.id, contract.context.robot, contract.context.registry) == (document["id"], "panda", REGISTRY.hash)
    for action, step in zip(contract.action_sequence, document["action_sequence"], strict=True):
        assert action.skill == step["skill"]
        assert action.params == step["params"]
        assert all(type(value) in (float, str) for value in action.params.values())


@pytest.mark.parametrize(("stage", "mutate"), [(s, m) for s, ms in MUTATIONS.items() for m in ms])
@settings(max_examples=25, deadline=None)
@given(document=contract_strategy(), data=st.data())
def test_a_single_mutation_fails_at_its_stage(stage: str, mutate: Any, document: dict[str, Any], data: Any) -> None:
    assume(mutate(document, data.draw))
    verdict = check_document(GATE, document)
    assert isinstance(verdict, Rejected), document
    assert (verdict.stage, CONJUNCTION.is_valid(document)) == (stage, False)
    assert SYNTAX.is_valid(document) == (stage != "syntax")
    assert len(json.dumps(verdict.got)) < 200
    assert verdict.hint
    assert verdict.allowed


@settings(max_examples=150, deadline=None)
@given(
    contract_strategy(), st.lists(st.sampled_from([m for ms in MUTATIONS.values() for m in ms]), max_size=3), st.data()
)
def test_the_published_schema_accepts_exactly_what_the_stages_accept(
    document: dict[str, Any], mutations: list[Any], data: Any
) -> None:
    for mutate in mutations:
        try:
            mutate(document, data.draw)
        except (AttributeError, LookupError, TypeError, ValueError, UnknownNameError):
            break  # an earlier mutation removed the part that this mutation changes
    verdict = check_document(GATE, document)
    assert isinstance(verdict, Accepted) == CONJUNCTION.is_valid(document)
    assert (isinstance(verdict, Rejected) and verdict.stage == "syntax") == (not SYNTAX.is_valid(document))


@settings(deadline=None)
@given(JSON)
def test_gate_and_published_schema_agree_on_any_json(document: Any) -> None:
    assert isinstance(check_document(GATE, document), Accepted) == CONJUNCTION.is_valid(document)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=400) | st.text(max_size=200).map(lambda text: text.encode("utf-8", "surrogatepass")))
def test_no_bytes_raise(data: bytes) -> None:
    assert isinstance(GATE.check(data, names=NAMES, principal=PRINCIPAL, now=0.0), Rejected)


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_a_damaged_contract_neither_raises_nor_is_accepted_in_part(data: Any) -> None:
    good = json.dumps(GOOD).encode()
    at, to = data.draw(st.integers(0, len(good))), data.draw(st.integers(0, len(good)))
    damaged = good[:at] + data.draw(st.binary(max_size=6)) + good[to:]
    verdict = GATE.check(damaged, names=NAMES, principal=PRINCIPAL, now=0.0)
    if isinstance(verdict, Accepted):
        assert CONJUNCTION.is_valid(json.loads(damaged))


FULL = 64 * 1024
HARD = {
    "brackets": "[" + "[]," * (FULL // 3 - 2) + "[]]",
    "many_fields": "{" + ",".join(f'"{i:x}":1' for i in range(7000)) + "}",
    "wrong_actions": json.dumps(GOOD | {"action_sequence": [{}] * 16000}),
    "number_actions": json.dumps(GOOD | {"action_sequence": [1] * 21000}),
    "wrong_values": json.dumps(
        GOOD | {"action_sequence": [{"skill": "homi", "params": {str(i): [] for i in range(64)}}] * 8}
    ),
    "long_skill": json.dumps(GOOD | {"action_sequence": [{"skill": "g" * 60000, "params": {}}]}),
    "long_escapes": '["' + "\\\\" * (FULL // 2 - 2) + '"]',
}


@pytest.mark.parametrize("text", HARD.values(), ids=HARD)
def test_the_slowest_known_inputs_are_rejected_in_a_quarter_of_a_second(text: str) -> None:
    assert len(text) <= FULL
    gc.freeze()  # the objects of other tests do not slow down the garbage collector
    start = time.process_time()
    verdict = GATE.check(text.encode(), names=NAMES, principal=PRINCIPAL, now=0.0)
    spent = time.process_time() - start
    gc.unfreeze()
    assert isinstance(verdict, Rejected)
    assert spent < 0.25


# --- each stage alone -----------------------------------------------------------------------------------------------


@settings(max_examples=100, deadline=None)
@given(st.lists(contract_strategy(), min_size=2, max_size=8), st.data())
def test_the_first_wrong_place_is_that_among_all_errors_of_the_document(documents: list[Any], data: Any) -> None:
    """The stage collects the errors of a part of the document only, and reports the same place and reason."""
    document = copy.deepcopy(documents[0])
    document["action_sequence"] = [one["action_sequence"][0] for one in documents]
    for _ in range(data.draw(st.integers(1, 4))):
        if not all(isinstance(one.get("params"), dict) for one in document["action_sequence"]):
            break
        action = data.draw(st.sampled_from(document["action_sequence"]))
        target = data.draw(st.sampled_from([document, action, action["params"]]))
        target[data.draw(st.sampled_from(["id", "skill", "params", "speed", "x", "y"]))] = data.draw(
            st.sampled_from([None, 1.0, "x", [1, [2]], {"a": {}}, True])
        )
    stage = SyntaxStage(REGISTRY)
    errors = list(stage._compiled.iter_errors(document))
    expected = _rejection(min(errors, key=_error_order), stage._schema) if errors else None
    assert stage.check(document) == expected


def test_a_rejection_at_an_earlier_stage_hides_the_later_ones() -> None:
    document = with_(("action_sequence", 0, "skill"), "hоme")
    document["action_sequence"][1]["params"]["reason"] = "x" * 161
    assert check_document(GATE, document).stage == "authorization"
    document["id"] = 7
    assert check_document(GATE, document).stage == "syntax"


@pytest.mark.parametrize(
    ("document", "stage", "pointer", "got", "hint"),
    [
        (
            with_(("action_sequence", 0, "params", "speed"), 0.9),
            "envelope",
            "/action_sequence/0/params/speed",
            0.9,
            "at most 0.4 m/s (site policy)",
        ),
        (
            with_(("action_sequence", 0, "params", "speed"), True),
            "syntax",
            "/action_sequence/0/params/speed",
            True,
            "write a JSON number here",
        ),
        (
            with_(("action_sequence", 0, "params"), {"sped": 0.1}),
            "syntax",
            "/action_sequence/0/params",
            "sped",
            "drop or rename this field; closest: 'speed'",
        ),
        (
            with_(("action_sequence", 0, "params"), {}),
            "syntax",
            "/action_sequence/0/params",
            None,
            "add the missing field 'speed'",
        ),
        (
            with_(("action_sequence", 0, "skill"), "hоme"),
            "authorization",
            "/action_sequence/0/skill",
            "h\\u043eme",
            "not a registered skill; closest: 'home'",
        ),
        (
            with_(("context", "robot"), "ur5e"),
            "authorization",
            "/context/robot",
            "ur5e",
            "this gate guards another robot",
        ),
        (
            with_(("action_sequence",), []),
            "syntax",
            "/action_sequence",
            "array of 0",
            "plan with fewer or with some actions",
        ),
        (with_(("id",), "c-0001\n"), "syntax", "/id", "c-0001\\n", "write an id like 'c-0001'"),
        (with_(("action_sequence", 1, "params"), {"a~/b": []}), "syntax", "/action_sequence/1/params", "a~/b", None),
    ],
)
def test_a_rejection_has_pointer_value_and_hint(
    document: dict[str, Any], stage: str, pointer: str, got: Any, hint: str | None
) -> None:
    verdict = check_document(GATE, document)
    assert (verdict.stage, verdict.pointer, verdict.got) == (stage, pointer, got)
    assert hint is None or verdict.hint == hint


def test_a_misspelt_name_is_answered_with_the_closest_one() -> None:
    params = {"target": "red_qube", "speed": 0.1, "clearance": 0.1, "route": "direct", "wait": "none"}
    verdict = check_document(GATE, with_(("action_sequence", 0), {"skill": "move_to", "params": params}))
    assert (verdict.stage, verdict.hint) == ("envelope", "closest: 'red_cube'")
    assert verdict.allowed == ["red_cube", "blue_cube", "tall_cup", "bowl", "left_spot"]


def test_names_are_those_of_the_current_scene() -> None:
    params = {"target": "red_cube", "speed": 0.1, "clearance": 0.1, "route": "direct", "wait": "none"}
    document = with_(("action_sequence", 0), {"skill": "move_to", "params": params})
    assert isinstance(check_document(GATE, document), Accepted)
    assert check_document(GATE, document, SceneNames((), ("bowl",))).stage == "envelope"


# --- grants, rules, registries --------------------------------------------------------------------------------------


def test_only_granted_skills_of_a_known_principal_pass() -> None:
    gate = Gate(REGISTRY, {PRINCIPAL: frozenset({"home"}), "guest": frozenset()})
    verdict = check_document(gate, GOOD)
    assert (verdict.stage, verdict.pointer, verdict.allowed) == (
        "authorization",
        "/action_sequence/1/skill",
        ["home"],
    )
    assert "not granted" in verdict.hint
    unknown = gate.check(json.dumps(GOOD).encode(), names=NAMES, principal="unknown", now=0.0)
    assert isinstance(unknown, Rejected)
    assert (unknown.stage, unknown.got) == ("authorization", "unknown")


def test_a_grant_of_an_unregistered_skill_is_an_error() -> None:
    with pytest.raises(UnknownNameError, match="Closest: 'grasp'"):
        Gate(REGISTRY, {PRINCIPAL: frozenset({"grasp_it"})})


def test_a_contract_for_other_bounds_is_refused() -> None:
    other = build_registry("panda_two")
    assert check_document(unrestricted_gate(other), GOOD).stage == "authorization"


def test_rules_judge_at_the_envelope_stage_in_order() -> None:
    seen: list[Contract] = []

    def record(contract: Contract) -> None:
        seen.append(contract)

    def reject(contract: Contract) -> Rejected:
        return Rejected(
            stage="syntax", pointer="/action_sequence/0", got="home", allowed="a reachable target", hint="out of reach"
        )

    gate = Gate(REGISTRY, {PRINCIPAL: frozenset(REGISTRY.by_name)}, (record, reject))
    verdict = check_document(gate, GOOD)
    assert (verdict.stage, verdict.hint) == ("envelope", "out of reach")
    assert [contract.id for contract in seen] == ["c-0007"]
    assert check_document(gate, with_(("id",), "")).stage == "syntax"
    assert len(seen) == 1


def test_the_error_of_a_rule_is_reported_in_bounded_printable_text() -> None:
    def fail(contract: Contract) -> None:
        raise ValueError(f"{contract.id}\n\x1b[31m\u202e{'x' * 10_000}")

    verdict = check_document(Gate(REGISTRY, {PRINCIPAL: frozenset(REGISTRY.by_name)}, (fail,)), GOOD)
    assert (verdict.stage, verdict.hint) == ("envelope", "a rule failed")
    assert verdict.got.startswith(r"ValueError: c-0007\n\x1b[31m\u202exxx")
    assert len(verdict.got) < 100


# --- the header -----------------------------------------------------------------------------------------------------


def check_with_header(
    gate: Gate, document: Any = GOOD, *, now: float = 1.0, version: int | None = 4, **changes: Any
) -> Any:
    """The verdict on `document` with a header that is valid except for `changes`."""
    fields = {"sequence": 1, "issued": 0.5, "expires": 2.0, "principal": PRINCIPAL, "scene_version": 4} | changes
    names = SceneNames(NAMES.graspable, NAMES.receptive, version)
    return gate.check(
        json.dumps(document).encode(), names=names, principal=PRINCIPAL, now=now, header=ContractHeader(**fields)
    )


@pytest.mark.parametrize(
    "changes",
    [
        {"principal": "guest"},
        {"issued": 1.5},
        {"expires": 1.0},
        {"expires": 0.1},
        {"scene_version": 3},
        {"issued": float("nan")},
        {"expires": float("nan")},
        {"now": float("nan")},
    ],
)
def test_a_header_for_another_principal_time_or_scene_is_rejected(changes: dict[str, Any]) -> None:
    gate = unrestricted_gate()
    assert check_with_header(gate, **changes).stage == "authorization"
    assert isinstance(check_with_header(gate), Accepted)


def test_a_sequence_number_is_accepted_once() -> None:
    gate = unrestricted_gate()
    assert isinstance(check_with_header(gate, sequence=5), Accepted)
    for used in (5, 4, -1):
        assert check_with_header(gate, sequence=used).stage == "authorization"
    assert isinstance(check_with_header(gate, sequence=9), Accepted)


def test_a_rejected_contract_does_not_consume_its_sequence_number() -> None:
    gate = unrestricted_gate()
    assert check_with_header(gate, with_(("action_sequence", 0, "params", "speed"), 9)).stage == "envelope"
    assert isinstance(check_with_header(gate), Accepted)


def test_without_a_scene_version_the_version_of_the_header_is_not_checked() -> None:
    assert isinstance(check_with_header(unrestricted_gate(), version=None), Accepted)
