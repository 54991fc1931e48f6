"""Equal contracts have one canonical text, in the order in which a constrained decoder generates it."""

import json

import msgspec
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dualbrain.contracts.canonical_form import canonical_contract, reorder_contract
from dualbrain.contracts.contract import Contract
from dualbrain.contracts.schema import decoding_schema
from tests.contracts.contract_strategies import NAMES, REGISTRY, contract_strategy


def shuffled(value, rng):
    """The same JSON value with all keys in another order and integers as floats."""
    if isinstance(value, dict):
        names = list(value)
        rng.shuffle(names)
        return {name: shuffled(value[name], rng) for name in names}
    if isinstance(value, list):
        return [shuffled(item, rng) for item in value]
    return float(value) if isinstance(value, int) else value


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(contract_strategy(), st.randoms(use_true_random=False))
def test_the_text_does_not_depend_on_the_order_of_the_source(document, rng):
    contract = msgspec.convert(document, Contract)
    text = canonical_contract(contract, REGISTRY)
    assert msgspec.json.decode(text, type=Contract) == contract
    other = msgspec.convert(shuffled(document, rng), Contract)
    assert canonical_contract(other, REGISTRY) == text


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(contract_strategy())
def test_reordering_a_document_with_sorted_keys_gives_the_order_of_the_text(document):
    text = canonical_contract(msgspec.convert(document, Contract), REGISTRY)
    sorted_document = json.loads(json.dumps(document, sort_keys=True))
    assert list(key_paths(reorder_contract(sorted_document, REGISTRY))) == list(key_paths(json.loads(text)))


def key_paths(value, path=()):
    """The path of every key of a JSON value, in the order in which the keys are written."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield (*path, name)
            yield from key_paths(item, (*path, name))
    elif isinstance(value, list):
        for number, item in enumerate(value):
            yield from key_paths(item, (*path, number))


@settings(max_examples=200)
@given(
    st.recursive(
        st.none() | st.text() | st.integers(),
        lambda part: (
            st.lists(part)
            | st.dictionaries(
                st.sampled_from(["skill", "params", "action_sequence", "id", "x"]),
                part | st.sampled_from(["grasp", "place"]),
            )
        ),
    )
)
def test_reordering_changes_no_content(value):
    for document in ({"action_sequence": value}, value):
        if isinstance(document, dict):
            assert reorder_contract(document, REGISTRY) == document


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(contract_strategy())
def test_keys_are_in_the_order_of_the_decoding_schema(document):
    text = canonical_contract(msgspec.convert(document, Contract), REGISTRY)
    assert has_order_of(json.loads(text), decoding_schema(REGISTRY, NAMES))
    assert text.isascii()
    assert not set("\n\t") & set(text)


def test_a_number_has_one_notation():
    steps = [{"skill": "home", "params": {"speed": value}} for value in (0.2, 0.20, 2e-1)]
    document = {"id": "c-1", "context": {"robot": "panda", "registry": "x"}, "action_sequence": steps}
    text = canonical_contract(msgspec.convert(document, Contract), REGISTRY)
    assert text.count('{"skill":"home","params":{"speed":0.2}}') == 3
    document["action_sequence"] = [{"skill": "hold", "params": {"duration": value}} for value in (1, 1.0)]
    text = canonical_contract(msgspec.convert(document, Contract), REGISTRY)
    assert text.count('"duration":1}') == 2


def has_order_of(value, schema):
    """Whether the keys of `value` are in the order of some branch of `schema`."""
    if "anyOf" in schema:
        return any(has_order_of(value, branch) for branch in schema["anyOf"])
    if isinstance(value, dict):
        known = schema.get("properties", {})
        return list(value) == list(known) and all(has_order_of(value[name], known[name]) for name in value)
    if isinstance(value, list):
        return all(has_order_of(item, schema["items"]) for item in value)
    return "const" not in schema or schema["const"] == value
