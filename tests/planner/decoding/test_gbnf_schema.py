"""Schemas for llama.cpp's grammars accept the same contracts as the decoding schema and can be parsed."""

import jsonschema_rs
import pytest

from dualbrain.contracts.schema import decoding_schema
from dualbrain.core.untrusted.hidden_characters import has_hidden_characters
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner.decoding.gbnf_schema import replace_text_patterns
from dualbrain.planner.decoding.llguidance_grammar import strip_annotations
from tests.planner.sample_requests import NAMES, REGISTRY

LONGEST = next(one.max_length for one in load_skill_registry("base").skill("decline").parameters)


def leaves(schema):
    """All values of `schema` that contain no other values, in order."""
    match schema:
        case dict():
            return [leaf for value in schema.values() for leaf in leaves(value)]
        case list():
            return [leaf for value in schema for leaf in leaves(value)]
        case _:
            return [schema]


@pytest.mark.parametrize("robot", ["panda", "ur5e", "base", "mobile_panda"])
def test_only_patterns_with_hidden_characters_are_removed(robot):
    schema = strip_annotations(decoding_schema(load_skill_registry(robot), NAMES))
    replaced = replace_text_patterns(schema)
    hidden = [one for one in leaves(schema) if has_hidden_characters(str(one))]
    assert len(hidden) == 1  # the reason of a decline
    assert [one for one in leaves(replaced) if one != LONGEST] == [one for one in leaves(schema) if one not in hidden]


@pytest.mark.parametrize("length", [0, 1, 40, 41])
def test_the_length_limit_of_a_text_is_kept(length):
    schema = decoding_schema(REGISTRY, NAMES)
    steps = [{"skill": "decline", "params": {"reason": "x" * length}}]
    contract = {
        "id": "c-0001",
        "context": {"robot": "panda", "registry": REGISTRY.hash},
        "action_sequence": steps,
    }
    verdicts = [
        jsonschema_rs.validator_for(one).is_valid(contract)
        for one in (strip_annotations(schema), replace_text_patterns(schema))
    ]
    assert verdicts == [length <= 40] * 2
