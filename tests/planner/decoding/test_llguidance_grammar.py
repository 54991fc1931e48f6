"""Grammars for the decoder: the schema without texts for people, in keywords that the decoder enforces."""

import json
from functools import cache

import pytest

from dualbrain.contracts.schema import decoding_schema
from dualbrain.contracts.skill_order import SkillOrder
from dualbrain.planner.decoding.llguidance_grammar import (
    NO_FORCING,
    actions_grammar,
    contract_grammar,
    strip_annotations,
    tail_grammar,
)
from tests.planner.sample_requests import NAMES, REGISTRY, plan_request


def test_texts_for_people_are_removed_and_names_of_parameters_are_not() -> None:
    number = {"type": "number", "minimum": 0, "maximum": 1, "x-unit": "m", "description": "how far"}
    schema = {"$schema": "x", "type": "object", "properties": {"description": number, "title": {"const": {"title": 1}}}}
    assert strip_annotations(schema) == {
        "type": "object",
        "properties": {"description": {"type": "number", "minimum": 0, "maximum": 1}, "title": {"const": {"title": 1}}},
    }


def test_the_grammar_contains_the_action_sequence_and_the_closing_brace() -> None:
    schema = plan_request().schema
    head, _, body = actions_grammar(schema).partition("%json ")
    assert head == f'{NO_FORCING}start: actions "}}"\nactions: '
    content = json.loads(body)
    assert content.pop("x-guidance") == {"whitespace_flexible": False}
    assert content == schema["properties"]["action_sequence"]


def test_shared_definitions_are_included() -> None:
    schema = {
        "properties": {"action_sequence": {"type": "array", "items": {"$ref": "#/$defs/step"}}},
        "$defs": {"step": {"enum": [1], "title": "a step"}},
    }
    assert '"$defs": {"step": {"enum": [1]}}' in actions_grammar(schema)


def accepts(grammar: str, text: str) -> bool:
    """Whether LLGuidance accepts `text` as a whole answer, byte by byte."""
    matcher = _matcher(grammar)
    matcher.reset()
    return matcher.try_consume_tokens(list(text.encode())) == len(text.encode()) and matcher.is_accepting()


@cache
def _matcher(grammar: str):
    llguidance = pytest.importorskip("llguidance", reason="the extra `adapt` is not installed")
    matcher = llguidance.LLMatcher(llguidance.LLTokenizer("byte"), llguidance.grammar_from("lark", grammar))
    assert not matcher.is_error(), matcher.get_error()
    return matcher


BOUNDS = ((0.03, 0.35), (0.02, 0.085), (-0.755, 0.855), (1.5, 3.1416), (0.05, 0.4))


@pytest.mark.parametrize(("lower", "upper"), BOUNDS)
def test_every_number_between_the_bounds_is_accepted_in_the_form_of_contracts(lower: float, upper: float) -> None:
    one = {"type": "number", "minimum": lower, "maximum": upper}
    grammar = contract_grammar({"type": "object", "properties": {"x": one}, "required": ["x"]})
    places = 3
    numbers = [round(lower, places) + k * 10**-places for k in range(int((upper - lower) * 10**places) + 2)]
    texts = {f"{number:.{places}f}".rstrip("0").rstrip(".") for number in numbers if number}
    wrong = [text for text in sorted(texts) if accepts(grammar, f'{{"x":{text}}}') != (lower <= float(text) <= upper)]
    assert not wrong


def test_each_grammar_accepts_its_part_of_a_contract_and_enforces_the_bounds() -> None:
    steps = '[{"skill":"grasp","params":{"object":"red_cube","speed":0.1}}]'
    whole = f'{{"id":"c-0007","context":{{"robot":"panda","registry":"{REGISTRY.hash}"}},"action_sequence":{steps}}}'
    grammars = {actions_grammar: '"action_sequence":', tail_grammar: '"action_sequence', contract_grammar: ""}
    for make, prefix in grammars.items():
        rest = whole.partition(prefix)[2] if prefix else whole
        assert accepts(make(plan_request().schema), rest)
        assert not accepts(make(plan_request().schema), rest.replace("0.1", "9.1"))
        assert not accepts(make(plan_request().schema), rest + " ")


def test_the_order_of_actions_is_restricted_where_the_engine_permits_it() -> None:
    hand = {"empty": {"grasp": "full"}, "full": {"place": "empty"}, "declined": {}}
    first = {"first": hand["full"] | {"decline": "declined"}}
    schema = decoding_schema(REGISTRY, NAMES, order=SkillOrder("first", first | hand))
    place = '{"skill":"place","params":{"destination":"blue_bowl","speed":0.2,"wait":"none"}}'
    grasp = '{"skill":"grasp","params":{"object":"red_cube","speed":0.2}}'
    decline = '{"skill":"decline","params":{"reason":"no"}}'
    right = (place, f"{place},{grasp}", f"{place},{grasp},{place}", decline)
    wrong = (grasp, f"{place},{place}", f"{place},{grasp},{grasp}", f"{decline},{place}", f"{place},{decline}")
    grammar = actions_grammar(schema)
    assert [accepts(grammar, f"[{one}]}}") for one in (*right, *wrong)] == [True] * len(right) + [False] * len(wrong)
    assert accepts(actions_grammar(plan_request().schema), f"[{grasp},{place}]}}")
    bounded = actions_grammar(decoding_schema(REGISTRY, NAMES, order=SkillOrder("first", first | hand), length=(2, 2)))
    right = (f"{place},{grasp}", decline)
    wrong = (place, f"{place},{grasp},{place}", f"{grasp},{place}", f"{place},{decline}", f"{decline},{place}")
    assert [accepts(bounded, f"[{one}]}}") for one in (*right, *wrong)] == [True] * len(right) + [False] * len(wrong)
    assert "prefixItems" in strip_annotations(schema, prefix_items=True)["properties"]["action_sequence"]
    assert "x-order" not in str(strip_annotations(schema))


def test_an_order_that_admits_nothing_is_left_out_and_the_gate_decides() -> None:
    schema = decoding_schema(REGISTRY, NAMES, order=SkillOrder("first", {"first": {}}))
    assert actions_grammar(schema).count("%json") == 1
