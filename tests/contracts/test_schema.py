"""All schema forms are equivalent, use only keywords that their readers enforce, and have units and provenance."""

from collections.abc import Iterator
from typing import Any

import jsonschema
import jsonschema_rs
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.schema import (
    decoding_schema,
    describe_skills,
    first_skills,
    syntax_schema,
    tool_schemas,
    validation_schema,
)
from dualbrain.contracts.skill_order import SkillOrder
from dualbrain.contracts.skill_spec import NameParameter, NumberParameter
from tests.contracts.contract_strategies import NAMES, REGISTRY, contract_strategy
from tests.contracts.mutations import MUTATIONS

DECODED = {
    "type",
    "properties",
    "required",
    "additionalProperties",
    "const",
    "enum",
    "anyOf",
    "items",
    "minItems",
    "maxItems",
    "minimum",
    "maximum",
    "pattern",
}
"""Keywords that LLGuidance and xgrammar enforce, by measurement."""

SCENES = [NAMES, SceneNames(("cup",), ()), SceneNames((), ("bowl",)), SceneNames()]
FORMS = [
    tuple(map(jsonschema_rs.Draft7Validator, (validation_schema(REGISTRY, names), decoding_schema(REGISTRY, names))))
    for names in SCENES
]


def keywords(schema: Any) -> Iterator[str]:
    """Every keyword in `schema`, not the names of properties."""
    for key, value in schema.items():
        yield key
        if key == "properties":
            for part in value.values():
                yield from keywords(part)
        elif key in ("items", "if", "then", "not") or (key == "additionalProperties" and isinstance(value, dict)):
            yield from keywords(value)
        elif key in ("anyOf", "allOf"):
            for part in value:
                yield from keywords(part)


@pytest.mark.parametrize("names", SCENES)
def test_all_forms_are_draft_07(names: SceneNames) -> None:
    for schema in (validation_schema(REGISTRY, names), decoding_schema(REGISTRY, names), syntax_schema(REGISTRY)):
        jsonschema.Draft7Validator.check_schema(schema)
        jsonschema_rs.Draft7Validator(schema)


@pytest.mark.parametrize("names", SCENES)
def test_every_skill_is_a_tool_with_the_parameters_of_its_step(names: SceneNames) -> None:
    tools = [tool["function"] for tool in tool_schemas(REGISTRY, names)]
    assert [tool["name"] for tool in tools] == [skill.name for skill in REGISTRY.skills]
    for tool, skill in zip(tools, REGISTRY.skills, strict=True):
        jsonschema.Draft7Validator.check_schema(tool["parameters"])
        assert list(tool["parameters"]["properties"]) == tool["parameters"]["required"]
        for parameter in skill.parameters:
            schema = tool["parameters"]["properties"][parameter.name]
            match parameter:
                case NumberParameter():
                    bounds = (schema["minimum"], schema["maximum"], schema["x-unit"])
                    assert bounds == (parameter.lower, parameter.upper, parameter.unit)
                case NameParameter():
                    assert schema.get("enum", []) == list(names.names_of_kind(parameter.of))
                case _:
                    assert schema["type"] == "string"


@pytest.mark.parametrize("names", SCENES)
def test_the_decoding_schema_uses_only_keywords_that_decoders_enforce(names: SceneNames) -> None:
    assert set(keywords(decoding_schema(REGISTRY, names))) <= DECODED
    assert {"allOf", "if", "then"} <= set(keywords(validation_schema(REGISTRY, names)))


@settings(max_examples=200, deadline=None)
@given(
    contract_strategy(),
    st.lists(st.sampled_from([m for ms in MUTATIONS.values() for m in ms]), max_size=1),
    st.sampled_from(FORMS),
    st.data(),
)
def test_both_forms_accept_the_same_contracts(
    document: dict[str, Any], mutations: list[Any], forms: tuple[Any, Any], data: Any
) -> None:
    for mutate in mutations:
        mutate(document, data.draw)
    validation, decoding = forms
    assert validation.is_valid(document) == decoding.is_valid(document)


def test_a_decoder_writes_fields_in_one_order() -> None:
    schema = decoding_schema(REGISTRY, NAMES)
    assert list(schema["properties"]) == ["id", "context", "action_sequence"]
    branches = schema["properties"]["action_sequence"]["items"]["anyOf"]
    for branch, skill in zip(branches, REGISTRY.skills, strict=True):
        assert list(branch["properties"]) == ["skill", "params"]
        assert branch["properties"]["skill"] == {"const": skill.name}
        assert list(branch["properties"]["params"]["properties"]) == [p.name for p in skill.parameters]


def test_a_skill_without_a_possible_target_cannot_be_decoded() -> None:
    def skills(names: SceneNames) -> list[str]:
        items = decoding_schema(REGISTRY, names)["properties"]["action_sequence"]["items"]
        return [branch["properties"]["skill"]["const"] for branch in items["anyOf"]]

    assert skills(SceneNames((), ("bowl",))) == ["move_to", "place", "release", "hold", "home", "turn_wrist", "decline"]
    assert skills(SceneNames()) == ["release", "hold", "home", "turn_wrist", "decline"]


def test_skills_that_the_state_refuses_are_left_out_of_the_first_action_only() -> None:
    everything = {skill.name: "later" for skill in REGISTRY.skills}
    later = {name: state for name, state in everything.items() if name not in ("grasp", "push")}
    free = decoding_schema(REGISTRY, NAMES)
    full = decoding_schema(REGISTRY, NAMES, order=SkillOrder("now", {"now": later, "later": everything}))
    assert first_skills(free) == tuple(skill.name for skill in REGISTRY.skills)
    assert first_skills(full) == tuple(name for name in first_skills(free) if name not in ("grasp", "push"))
    actions = full["properties"]["action_sequence"]
    assert actions["items"] == free["properties"]["action_sequence"]["items"]


def test_a_registry_without_a_callable_skill_admits_no_contract() -> None:
    grasp = SkillRegistry("panda", (REGISTRY.skill("grasp"),))
    schema = decoding_schema(grasp, SceneNames())
    document = {"id": "c-0001", "context": {"robot": "panda", "registry": grasp.hash}, "action_sequence": [{}]}
    assert not jsonschema_rs.Draft7Validator(schema).is_valid(document)


def test_every_number_has_its_unit_and_the_provenance_of_its_bounds() -> None:
    branches = validation_schema(REGISTRY, NAMES)["properties"]["action_sequence"]["items"]["allOf"]
    for branch, skill in zip(branches, REGISTRY.skills, strict=True):
        properties = branch["then"]["properties"]["params"]["properties"]
        for number in (p for p in skill.parameters if isinstance(p, NumberParameter)):
            schema = properties[number.name]
            assert schema["x-unit"] == number.unit
            assert f"[{number.unit}]" in schema["description"]
            assert number.lower_from in schema["description"]
            assert number.upper_from in schema["description"]


def test_errors_of_the_validation_schema_name_the_exact_place() -> None:
    params = {"speed": 9}
    document = {"id": "c-0001", "context": {"robot": "panda", "registry": REGISTRY.hash}}
    document |= {"action_sequence": [{"skill": "home", "params": params}]}
    (error,) = jsonschema.Draft7Validator(validation_schema(REGISTRY, NAMES)).iter_errors(document)
    assert list(error.absolute_path) == ["action_sequence", 0, "params", "speed"]
    assert error.message == "9 is greater than the maximum of 0.4"


def test_the_prompt_text_names_everything_that_the_schema_bounds() -> None:
    text = describe_skills(REGISTRY, NAMES)
    for skill in REGISTRY.skills:
        (line,) = [line for line in text.splitlines() if line.startswith(f"{skill.name}(")]
        assert skill.description in line
        for parameter in skill.parameters:
            assert f"{parameter.name}: " in line
            if isinstance(parameter, NumberParameter):
                assert f"{parameter.lower:g}..{parameter.upper:g} {parameter.unit}" in line
            if isinstance(parameter, NameParameter) and parameter.of != "any":
                assert f"{parameter.of} name" in line
    assert "graspable: red_cube, blue_cube, tall_cup" in text
    assert describe_skills(REGISTRY, SceneNames()).endswith("graspable: nothing\nreceptive: nothing")


@pytest.mark.parametrize("identity", ["c-0001\n", "c-00011", "xc-0001", "c-٠٠٠١"])
def test_no_reader_accepts_an_id_with_trailing_characters(identity: str) -> None:
    context = {"robot": "panda", "registry": REGISTRY.hash}
    steps = [{"skill": "home", "params": {"speed": 0.1}}]
    document = {"id": identity, "context": context, "action_sequence": steps}
    for reader in (jsonschema.Draft7Validator, jsonschema_rs.Draft7Validator):
        for schema in (validation_schema(REGISTRY, NAMES), syntax_schema(REGISTRY)):
            assert not reader(schema).is_valid(document)
            assert reader(schema).is_valid(document | {"id": "c-0001"})
