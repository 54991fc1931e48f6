"""The bytes of a contract in a message of MCP reach the gate unchanged."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.agent_server.contract_text import MALFORMED, contract_as_text

JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**60), 2**60)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


def call(contract: str) -> bytes:
    head = '{"jsonrpc":"2.0","id":7,"method":"tools/call","params":{"name":"check_contract","arguments":{"contract":'
    return (head + contract + ',"wait_s":1}}}').encode()


@given(JSON.filter(lambda value: not isinstance(value, str)), st.sampled_from([None, 1]), st.booleans())
def test_a_contract_becomes_a_string_with_its_text(value, indent, ascii_only):
    text = json.dumps(value, indent=indent, ensure_ascii=ascii_only)
    message = json.loads(contract_as_text(call(text)))
    assert message["params"]["arguments"] == {"contract": text, "wait_s": 1}
    assert (message["id"], message["params"]["name"]) == (7, "check_contract")


@pytest.mark.parametrize("text", ['{"id":1,"id":2}', "1.500e0", '{"a":1E400}', "[1,\n 2]", '{"\\u0061":0.10}'])
def test_form_that_a_parser_would_lose_is_kept(text):
    assert json.loads(contract_as_text(call(text)))["params"]["arguments"]["contract"] == text


def test_a_string_is_kept_as_it_is():
    assert json.loads(contract_as_text(call('"{\\"id\\": 1}"')))["params"]["arguments"]["contract"] == '{"id": 1}'


@pytest.mark.parametrize("key", ["contract", "\\u0063ontract", "c\\u006fntract"])
def test_an_escaped_name_of_the_argument_is_found(key):
    message = call('{"id":1,"id":2}').replace(b'"contract"', f'"{key}"'.encode())
    assert json.loads(contract_as_text(message))["params"]["arguments"]["contract"] == '{"id":1,"id":2}'


def test_equal_keys_of_a_message_have_one_meaning():
    both = call("[1]").replace(b'"id":7,', b'"id":7,"params":{"arguments":{"contract":[2]}},')
    first = call("[1]")[:-1] + b',"params":{"arguments":{}}}'
    assert contract_as_text(both).count(b"arguments") == 1
    assert json.loads(contract_as_text(both))["params"]["arguments"]["contract"] == "[1]"
    assert b"contract" not in contract_as_text(first).replace(b"check_contract", b"")


@pytest.mark.parametrize("message", [b"", b"{}", b'{"method":"ping"}', b"[]", b"nonsense", b"\xff"])
def test_a_message_without_a_contract_is_not_changed(message):
    assert contract_as_text(message) == message


@pytest.mark.parametrize(
    "message",
    [call("NaN"), call("Infinity"), call("{"), call("[" * 5000), call('"\\ud800'), b'"contract"', b'["contract"]'],
)
def test_a_message_that_is_no_object_becomes_malformed(message):
    assert contract_as_text(message) == MALFORMED


@given(st.binary(max_size=200))
def test_any_bytes_give_bytes(data):
    assert isinstance(contract_as_text(b'{"contract":' + data), bytes)
