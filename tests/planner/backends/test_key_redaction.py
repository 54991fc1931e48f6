"""A server that repeats the key, in any field and in the usual encodings, does not write it into a record."""

import base64
import json
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.planner import protocol
from dualbrain.planner.backends.key_redaction import (
    HIDDEN,
    REDACTED,
    KeyRedactor,
    has_secret_parts,
    public_address,
    public_planner,
)
from dualbrain.planner.backends.openai_server import ServerConfig, ServerPlanner
from dualbrain.planner.backends.stderr_tail import StderrTail
from dualbrain.records import Proposal
from tests.planner.backends.fake_chat_server import chat_completion, respond_with, serve
from tests.planner.sample_requests import plan_request
from tests.support.growth import growth_of_cost

KEY = "sk-Secret/live+key=0042~A"
ESCAPED = "".join(f"\\u{ord(character):04x}" for character in KEY)
ENCODINGS = {
    "plain": KEY,
    "lower case": KEY.lower(),
    "address": quote(KEY, safe=""),
    "address, all": "".join(f"%{ord(character):02X}" for character in KEY),
    "address, twice": quote(quote(KEY, safe=""), safe=""),
    "base64": base64.b64encode(KEY.encode()).decode(),
    "base64 in a header": base64.b64encode(f"user:{KEY}:x".encode()).decode(),
    "base64 of a longer text": base64.b64encode(f"the key {KEY} is wrong".encode()).decode(),
    "base64 for addresses": base64.urlsafe_b64encode(KEY.encode()).decode(),
    "hexadecimal": KEY.encode().hex(),
    "hexadecimal, upper case": KEY.encode().hex().upper(),
    "escaped": ESCAPED,
    "escaped in part": KEY.replace("S", "\\u0053"),
    "escaped twice": ESCAPED.replace("\\", "\\u005c"),
    "backslash x": "".join(f"\\x{ord(character):02x}" for character in KEY),
    "escaped slashes": KEY.replace("/", "\\/"),
    "HTML": "".join(f"&#{ord(character)};" for character in KEY),
    "HTML, hexadecimal": "".join(f"&#x{ord(character):X};" for character in KEY),
    "wrapped lines": f"{KEY[:8]}\n    {KEY[8:]}",
    "zero-width characters": "\u200b".join(KEY),
    "concatenated": f'"{KEY[:5]}" + "{KEY[5:]}"',
    "full width": "".join(chr(ord(character) + 0xFEE0) for character in KEY),
}


def ask(body: bytes, status: int = 200, dialect: str = "openai") -> Proposal:
    with serve(respond_with(body, status)) as server:
        config = ServerConfig(url=server.url, timeout_s=5.0, key=KEY, model="m", dialect=dialect)
        return ServerPlanner(config).propose(plan_request())


def reveals(proposal: Proposal) -> bool:
    """Whether a record of the proposal has the key, in part or in an encoded form."""
    record = json.dumps([proposal.text, proposal.finish_reason, proposal.constrained_by, proposal.planner])
    return any(
        piece in record or json.dumps(piece)[1:-1] in record
        for encoded in (*ENCODINGS.values(), ascii(ENCODINGS["full width"])[1:-1])
        for piece in (encoded, encoded[: max(6, len(encoded) // 3)])
    )


def responses(value: str) -> dict[str, bytes]:
    """Responses with `value` in each field that is read."""
    whole = json.loads(chat_completion("{}"))
    return {
        "content": chat_completion(f'{{"reason": "{value}"}}'),
        "cut content": chat_completion(f"{value} and", "length"),
        "finish reason": chat_completion("{}", value),
        "finish reason after a text": chat_completion("{}", "x" * 112 + value),
        "refusal": chat_completion(None, refusal=value),
        "refusal after a text": chat_completion(None, refusal="x" * 112 + value),
        "fingerprint": json.dumps(whole | {"system_fingerprint": value}).encode(),
        "fingerprint after a text": json.dumps(whole | {"system_fingerprint": "x" * 30 + value}).encode(),
        "model": json.dumps(whole | {"model": value, value: value}).encode(),
        "tool call": chat_completion(None, "tool_calls", tool_calls=[{"function": {"name": value}}]),
        "nested": chat_completion(None, {"reason": [value]}, refusal={"why": [value]}),
    }


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("field", responses(""))
def test_the_key_is_in_no_field_of_a_proposal(field: str, encoding: str) -> None:
    assert not reveals(ask(responses(ENCODINGS[encoding])[field]))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_key_is_in_no_error(encoding: str) -> None:
    value = ENCODINGS[encoding]
    for body in (value.encode(), b"x" * 112 + value.encode(), json.dumps({"error": [value]}).encode()):
        assert not reveals(ask(body, 401))
    assert not reveals(ask(f'{{"error": "{ESCAPED}"'.encode(), 500))
    assert not reveals(ask(KEY.encode("utf-16"), 500))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_key_is_in_no_response_of_ollama(encoding: str) -> None:
    value = ENCODINGS[encoding]
    for content, reason in ((value, "stop"), ("{}", value), ("{}", [value])):
        body = {"message": {"content": content}, "done": True, "done_reason": reason}
        assert not reveals(ask(json.dumps(body).encode(), dialect="ollama"))


def test_a_deeply_nested_response_does_not_hide_the_key() -> None:
    body = '{"x": %s%s, "choices": [{"message": {"content": "%s"}, "finish_reason": "stop"}]}'
    for depth in range(100, 1000, 50):
        assert not reveals(ask((body % ("[" * depth, "]" * depth, ESCAPED)).encode()))
        nested = json.loads("[" * min(depth, 900) + "]" * min(depth, 900))
        assert ask(chat_completion(None, refusal=nested)).finish_reason.startswith(protocol.REFUSAL)


def test_an_answer_without_the_key_is_not_changed() -> None:
    text = '{"id": "c-0007", "reason": "the key of the box \\u0041 %41"}'
    assert ask(chat_completion(text)).text == text


@given(st.text(max_size=200))
def test_texts_without_the_key_are_not_changed(text: str) -> None:
    assert KeyRedactor(KEY).redact_text(text) == text
    assert KeyRedactor("").redact_text(text) == text
    assert KeyRedactor("x").redact_text(text) == text


@given(st.text(alphabet=st.characters(min_codepoint=33, max_codepoint=126), min_size=8, max_size=60), st.data())
def test_every_key_is_removed_from_every_encoding(key: str, data: st.DataObject) -> None:
    before, after = data.draw(st.text("abc :", max_size=5)), data.draw(st.text("abc :", max_size=5))
    redactor = KeyRedactor(key)
    encoded = base64.b64encode(f"{before}{key}{after}".encode()).decode()
    assert key not in redactor.redact_text(before + key + after)
    if len(redactor._encoded_forms) > 3:  # a key of separators only has no encoded form
        assert redactor.redact_text(f"<{encoded}>") == REDACTED


def test_a_password_in_an_address_is_not_reported() -> None:
    assert public_address("http://user:pass@host:8000/v1?token=abc#x") == "http://host:8000/v1"
    url = "http://user:pa55word@127.0.0.1:9/v1"
    reason = ServerPlanner(ServerConfig(url=url, timeout_s=2.0)).propose(plan_request()).finish_reason
    assert "no connection to http://127.0.0.1:9/v1" in reason
    assert "pa55word" not in reason


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("https://user:pa55word@host/v1?key=pa55word", "https://host/v1"),
        ("http://[::1]:80/v1#m", "http://[::1]:80/v1"),
        ("host:80/v1?key=pa55word", "host:80/v1"),
        ("user:pa55word@host/v1", HIDDEN),
        ("http://user:pa55/word@host/v1", f"http://{HIDDEN}"),
        ("http://user:pa@55/word@host/v1", f"http://{HIDDEN}"),
        ("http://user:pa55?word@host/v1", f"http://{HIDDEN}"),
        ("http://user:pa55", f"http://{HIDDEN}"),  # the part before # of an address with #word@host
        ("user:pa55://word@http://host", HIDDEN),
    ],
)
def test_no_part_of_a_password_is_in_a_public_address(url: str, shown: str) -> None:
    assert public_address(url) == shown


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("base-135m", "base-135m"),
        ("models/a@b.gguf", "models/a@b.gguf"),
        ("http://host/v1#vendor@1&languages=en", "http://host/v1#vendor@1&languages=en"),
        ("shadow:ab@vllm+http://user:pa55word@host:1/v1?key=1#m", "shadow:ab@vllm+http://host:1/v1#m"),
        ("http://user:pa55#word@host/v1#m", f"http://{HIDDEN}"),
    ],
)
def test_the_name_of_a_planner_is_recorded_without_secrets(name: str, shown: str) -> None:
    assert public_planner(name) == shown


@pytest.mark.parametrize(
    ("name", "secret"),
    [
        ("base-135m", False),
        ("models/a@b.gguf", False),
        ("http://host/v1#vendor@1?x", False),
        ("https://host/v1?api-version=2026-01-01#m", False),
        ("https://host/v1?api-version=1&key=abc#m", True),
        ("https://host/v1?key=abc#m", True),
        ("shadow:ab@vllm+http://user:pa55word@host/v1#m", True),
        ("http://user@host/v1#m", True),
    ],
)
def test_an_address_with_secret_parts_is_recognised(name: str, secret: bool) -> None:
    assert has_secret_parts(name) is secret


@pytest.mark.parametrize("unit", ["\\u0061", "\\", "%25", "&#0", "&#", "\\u", '{"a":1,', "\u200b ", KEY[:-1], KEY])
def test_the_cost_of_the_redaction_is_linear(unit: str) -> None:
    redactor = KeyRedactor(KEY)
    assert growth_of_cost(lambda size: redactor.redact_text(unit * (size // len(unit))), 1 << 16) < 2.0


def test_the_end_of_standard_error_has_no_part_of_the_key(tmp_path) -> None:
    for filler in range(4096 - 60, 4096 + 10):
        (tmp_path / "stderr").write_bytes(b"y" * 50 + KEY.encode() + b"\n" + b" " * filler)
        with (tmp_path / "stderr").open("rb") as pipe:
            text = StderrTail(pipe, secret=KEY).text()
        assert KEY[-6:] not in text
