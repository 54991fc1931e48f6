"""What a decoder is bound to: the schema without words for people, in keywords that decoders enforce."""

import json

from dualbrain.planner.grammar import actions_grammar, narrow
from tests.planner.questions import request


def test_words_for_people_are_left_out_and_names_of_parameters_are_not() -> None:
    number = {"type": "number", "minimum": 0, "maximum": 1, "x-unit": "m", "description": "how far"}
    schema = {"$schema": "x", "type": "object", "properties": {"description": number, "title": {"const": {"title": 1}}}}
    assert narrow(schema) == {
        "type": "object",
        "properties": {"description": {"type": "number", "minimum": 0, "maximum": 1}, "title": {"const": {"title": 1}}},
    }


def test_the_grammar_holds_the_action_sequence_and_the_closing_brace() -> None:
    schema = request().schema
    head, _, body = actions_grammar(schema).partition("%json ")
    assert head == '%llguidance {}\nstart: actions "}"\nactions: '
    told = json.loads(body)
    assert told.pop("x-guidance") == {"whitespace_flexible": False}
    assert told == schema["properties"]["action_sequence"]


def test_shared_definitions_travel_along() -> None:
    schema = {
        "properties": {"action_sequence": {"type": "array", "items": {"$ref": "#/$defs/step"}}},
        "$defs": {"step": {"enum": [1], "title": "a step"}},
    }
    assert '"$defs": {"step": {"enum": [1]}}' in actions_grammar(schema)
