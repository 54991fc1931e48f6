"""Any response of a server, or none, becomes a proposal with a finish reason and never an exception."""

import json
import re
import socket
import threading
import time
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.contracts.verdict import Rejected
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.planner import protocol
from dualbrain.planner.backends import http_chat, ollama
from dualbrain.planner.backends.openai_server import DIALECTS, ServerConfig, ServerPlanner
from dualbrain.planner.decoding.gbnf_schema import replace_text_patterns
from dualbrain.planner.decoding.llguidance_grammar import contract_grammar, strip_annotations
from dualbrain.planner.introspection import no_documents_reason, planner_template
from dualbrain.planner.prompt.full_prompt import render
from dualbrain.planner.prompt.prompt_format import SHORT_PROMPT
from dualbrain.planner.registry import open_planner
from dualbrain.records import Proposal
from tests.planner.backends.fake_chat_server import Behaviour, FakeServer, chat_completion, respond_with, serve
from tests.planner.sample_requests import plan_request
from tests.support.growth import growth_of_cost

CONTRACT = '{"id":"c-0007"}'


def ask(behaviour: Behaviour, timeout_s: float = 5.0, **config: str) -> tuple[Proposal, FakeServer]:
    with serve(behaviour) as server:
        planner = ServerPlanner(ServerConfig(url=server.url, timeout_s=timeout_s, **config))
        return planner.propose(plan_request()), server


def drip(call: BaseHTTPRequestHandler) -> None:
    """Send endless single bytes: each one is in time, the complete response never is."""
    call.send_response(200)
    call.send_header("Content-Length", "1000000")
    call.end_headers()
    while not call.server.closing.wait(0.02):
        call.wfile.write(b" ")
        call.wfile.flush()


def silence(call: BaseHTTPRequestHandler) -> None:
    call.server.closing.wait(10.0)


def hang_up(call: BaseHTTPRequestHandler) -> None:
    call.close_connection = True


def flood(call: BaseHTTPRequestHandler) -> None:
    call.send_response(200)
    call.end_headers()
    for _ in range(4 * http_chat.MAX_RESPONSE_BYTES // 65536):
        call.wfile.write(b"[" * 65536)


def test_a_valid_response_becomes_a_proposal_with_its_metrics() -> None:
    proposal, server = ask(respond_with(chat_completion(CONTRACT)), model="m", key="secret")
    assert (proposal.text, proposal.finish_reason) == (CONTRACT, protocol.STOP)
    assert proposal.timings["output_tokens"] == 20
    assert proposal.timings["total"] > 0
    assert "secret" not in repr(proposal)
    (path, body), headers = server.requests[0], server.headers[0]
    assert path == "/v1/chat/completions"
    assert headers["Authorization"] == "Bearer secret"
    assert body["messages"] == render(plan_request())
    assert body["response_format"]["json_schema"]["strict"] is True


def test_an_adapted_model_gets_the_prompt_on_which_it_was_trained() -> None:
    with serve(respond_with(chat_completion(CONTRACT))) as server:
        planner = open_planner(f"{server.url}#adapter-7&prompt=short", Path())
        planner.propose(plan_request())
    body = server.requests[0][1]
    assert (body["model"], body["messages"]) == ("adapter-7", SHORT_PROMPT.messages(plan_request()))
    assert (body["temperature"], body["seed"]) == (0.0, 0)
    assert (
        planner_template(planner) == SHORT_PROMPT.template_hash() != planner_template(open_planner(server.url, Path()))
    )
    assert "documents are not shown" in no_documents_reason(planner)


def test_a_repeated_question_to_an_adapted_model_is_sampled_as_on_this_machine() -> None:
    again = plan_request(rejection=Rejected(stage="envelope", pointer="/x", got=1, allowed="2", hint="h"))
    with serve(respond_with(chat_completion(CONTRACT))) as server:
        for prompt in ("short", "full"):
            ServerPlanner(ServerConfig(url=server.url, prompt=prompt)).propose(again)
    short, full = (body for _, body in server.requests)
    assert (short["temperature"], short["seed"]) == (1.0, SHORT_PROMPT.sampling_seed(again))
    assert (full["temperature"], full["seed"]) == (0.0, 0)


def test_an_unknown_prompt_is_refused_by_name() -> None:
    with pytest.raises(UnknownNameError, match="'shrt' is not a prompt of a server"):
        open_planner("http://127.0.0.1:1/v1#m&prompt=shrt", Path())


def ollama_response(text: str, reason: str = "stop", **fields: object) -> Behaviour:
    """A response in the format of Ollama."""
    message = {"role": "assistant", "content": text}
    metrics = {"prompt_eval_count": 90, "eval_count": 12, "eval_duration": 3_000_000_000}
    return respond_with(
        json.dumps({"message": message, "done": True, "done_reason": reason} | metrics | fields).encode()
    )


@pytest.mark.parametrize("dialect", DIALECTS)
def test_each_dialect_is_recorded_and_sends_no_texts_for_people(dialect: str) -> None:
    behaviour = ollama_response(CONTRACT) if dialect == "ollama" else respond_with(chat_completion(CONTRACT))
    proposal, server = ask(behaviour, dialect=dialect)
    assert (proposal.text, proposal.finish_reason) == (CONTRACT, protocol.STOP)
    assert proposal.constrained_by == DIALECTS[dialect].constrained_by
    body = repr({key: value for key, value in server.requests[0][1].items() if key != "messages"})
    assert "$schema" not in body
    assert ("decline" in body) == (dialect != "free")


SCHEMA = strip_annotations(plan_request().schema)
FIELDS = {
    "openai": (
        "response_format",
        {"type": "json_schema", "json_schema": {"name": "contract", "strict": True, "schema": SCHEMA}},
    ),
    "vllm": ("structured_outputs", {"json": SCHEMA}),
    "llama.cpp": (
        "response_format",
        {
            "type": "json_schema",
            "json_schema": {"name": "contract", "strict": True, "schema": replace_text_patterns(plan_request().schema)},
        },
    ),
    "llguidance": ("grammar", contract_grammar(plan_request().schema)),
    "ollama": ("format", replace_text_patterns(plan_request().schema)),
}


@pytest.mark.parametrize("dialect", DIALECTS)
def test_each_server_receives_the_schema_in_its_own_field_only(dialect: str) -> None:
    _, server = ask(
        ollama_response(CONTRACT) if dialect == "ollama" else respond_with(chat_completion(CONTRACT)), dialect=dialect
    )
    path, body = server.requests[0]
    assert path == ("/api/chat" if dialect == "ollama" else "/v1/chat/completions")
    schema_fields = {"response_format", "structured_outputs", "grammar", "format", "guided_json", "json_schema"}
    name, value = FIELDS.get(dialect, ("", None))
    assert {key: body[key] for key in schema_fields & body.keys()} == ({name: value} if name else {})
    assert body["stream"] is False
    assert body.get("temperature", body.get("options", {}).get("temperature")) == 0.0


def test_ollama_requests_enough_context_and_its_metrics_are_read() -> None:
    proposal, server = ask(ollama_response(CONTRACT), dialect="ollama", model="m")
    body = server.requests[0][1]
    assert body["options"]["num_ctx"] >= 8192
    assert (body["messages"], body["model"]) == (render(plan_request()), "m")
    assert (proposal.timings["decode"], proposal.timings["prompt_tokens"]) == (3.0, 90)
    assert ask(ollama_response("{", "length"), dialect="ollama")[0].finish_reason == protocol.LENGTH


@pytest.mark.parametrize(
    "behaviour",
    [
        ollama_response(CONTRACT, "load"),
        ollama_response(CONTRACT, done=False),
        respond_with(b'{"error":"no such model"}', 404),
        respond_with(b"[]"),
        respond_with(b'{"message":{"content":null},"done":true}'),
        respond_with(chat_completion(CONTRACT)),
    ],
    ids=["odd finish", "not done", "404", "a list", "no text", "another interface"],
)
def test_an_invalid_response_of_ollama_becomes_a_finish_reason(behaviour: Behaviour) -> None:
    proposal, _ = ask(behaviour, dialect="ollama")
    assert (proposal.text, proposal.finish_reason.split(":")[0]) == ("", protocol.ERROR)


def test_the_fingerprint_of_a_server_is_recorded_in_printable_text() -> None:
    body = json.loads(chat_completion(CONTRACT)) | {"system_fingerprint": "b7000-abc\n<|im_end|>" + "x" * 400}
    proposal, _ = ask(respond_with(json.dumps(body).encode()))
    assert "; b7000-abc" in proposal.constrained_by
    assert proposal.constrained_by.isprintable()
    assert len(proposal.constrained_by) < 120


@pytest.mark.parametrize("fence", ["```json\n%s\n```", "```\n%s\n```", "\n ```json\n%s```\n"])
def test_a_code_fence_is_removed_and_recorded(fence: str) -> None:
    proposal, _ = ask(respond_with(chat_completion(fence % CONTRACT)))
    assert proposal.text == CONTRACT
    assert "code fence stripped" in proposal.constrained_by


def test_a_fence_inside_the_text_is_kept() -> None:
    text = 'here: ```json\n{"id":1}\n```'
    assert http_chat.strip_fence(text) == (text, False)


def fence_by_expression(text: str) -> tuple[str, bool]:
    """Definition of a code fence around a text; its cost grows with the third power of the length."""
    fenced = re.fullmatch(r"\s*```[a-zA-Z]*\s*\n(.*?)\n?\s*```\s*", text, flags=re.DOTALL)
    return (fenced.group(1), True) if fenced else (text, False)


@settings(max_examples=500)
@given(
    st.lists(
        st.sampled_from(["```", "`", "\n", " ", "json", "a", "{}", "\t", "\r", "\u2028", "\xe9", "1"]), max_size=12
    )
)
def test_a_fence_is_what_the_expression_defines(pieces: list[str]) -> None:
    for text in ("".join(pieces), f"```{''.join(pieces)}```"):
        assert http_chat.strip_fence(text) == fence_by_expression(text)


LOOPS = [
    "\n",
    "```",
    "```\n",
    "\n```",
    "`",
    "<think>",
    "</think>\n",
    " \n",
    "\t",
    "\r\n",
    "a\n \n",
    "json\n",
    "{",
    "\u2028",
]


@pytest.mark.parametrize("unit", LOOPS)
@pytest.mark.parametrize("frame", ["%s", "```%s", "```\n%s", "```json\n%s\n```", "```%sx"])
def test_the_cost_of_an_answer_that_repeats_itself_is_linear(unit: str, frame: str) -> None:
    """A small model that loops must not hold the interpreter, which also sends the heartbeats."""

    def propose(size: int) -> None:
        text = frame % (unit * (size // len(unit)))
        http_chat.strip_fence(http_chat.parse_completion(chat_completion(text)).text)

    assert growth_of_cost(propose, 1 << 10) < 2.0


def test_the_time_limit_includes_the_processing_of_the_response() -> None:
    times = iter([0.0, 5.1, 5.1, 5.1, 5.1])
    with serve(respond_with(chat_completion(CONTRACT))) as server:
        planner = ServerPlanner(ServerConfig(url=server.url, timeout_s=5.0), clock=lambda: next(times))
        proposal = planner.propose(plan_request())
    assert (proposal.text, proposal.finish_reason) == ("", protocol.TIMEOUT)


REFUSED = chat_completion(None, refusal="I will not")
BAD = {
    "garbage": (respond_with(b"\xff\x00 not json"), protocol.ERROR),
    "empty": (respond_with(b""), protocol.ERROR),
    "NaN": (respond_with(b"NaN"), protocol.ERROR),
    "a number": (respond_with(b"7"), protocol.ERROR),
    "deep": (respond_with(b"[" * 200_000), protocol.ERROR),
    "no choices": (respond_with(b'{"choices":[]}'), protocol.ERROR),
    "choices of text": (respond_with(b'{"choices":"abc"}'), protocol.ERROR),
    "null message": (respond_with(b'{"choices":[{"message":null,"finish_reason":"stop"}]}'), protocol.ERROR),
    "no text": (respond_with(chat_completion(None)), protocol.ERROR),
    "tool call": (respond_with(chat_completion(None, "tool_calls")), protocol.ERROR),
    "odd finish": (respond_with(chat_completion(CONTRACT, "because")), protocol.ERROR),
    "finish of another type": (respond_with(chat_completion(CONTRACT, ["stop"])), protocol.ERROR),
    "half a character": (respond_with(chat_completion(CONTRACT, "\ud800")), protocol.ERROR),
    "half a refusal": (respond_with(chat_completion(None, refusal="\ud800 no")), protocol.REFUSAL),
    "500": (respond_with(b'{"error":{"message":"boom"}}', 500), protocol.ERROR),
    "401": (respond_with(b"who are you", 401), protocol.ERROR),
    "redirect": (respond_with(b"", 307), protocol.ERROR),
    "refusal": (respond_with(REFUSED), protocol.REFUSAL),
    "content filter": (respond_with(chat_completion("", "content_filter")), protocol.REFUSAL),
    "hang up": (hang_up, protocol.ERROR),
    "flood": (flood, protocol.ERROR),
}


@pytest.mark.parametrize("name", BAD)
def test_an_invalid_response_becomes_a_finish_reason(name: str) -> None:
    behaviour, expected = BAD[name]
    proposal, _ = ask(behaviour)
    assert proposal.text == ""
    assert proposal.finish_reason.split(":")[0] == expected
    assert len(proposal.finish_reason) < 700
    assert proposal.finish_reason.isprintable()


def test_a_cut_answer_is_marked() -> None:
    proposal, _ = ask(respond_with(chat_completion('{"id":', "length")))
    assert proposal.finish_reason == protocol.LENGTH


def test_invalid_metrics_are_left_out() -> None:
    body = chat_completion(CONTRACT).replace(b"100", b'"many"').replace(b"20", b"1" + b"0" * 400)
    proposal, _ = ask(respond_with(body))
    assert proposal.text == CONTRACT
    assert set(proposal.timings) == {"total"}


@pytest.mark.parametrize("behaviour", [silence, drip])
def test_the_time_limit_covers_the_whole_response(behaviour: Behaviour) -> None:
    start = time.monotonic()
    proposal, _ = ask(behaviour, timeout_s=0.3)
    assert proposal.finish_reason == protocol.TIMEOUT
    assert time.monotonic() - start < 3.0


@pytest.mark.parametrize(("dialect", "path"), [("openai", "/v1/chat/completions"), ("ollama", "/api/chat")])
def test_the_query_of_an_address_follows_the_path(dialect: str, path: str) -> None:
    with serve(respond_with(chat_completion(CONTRACT))) as server:
        for url in (f"{server.url}?version=1", f"{server.url}/?version=1"):
            ServerPlanner(ServerConfig(url=url, dialect=dialect)).propose(plan_request())
    assert [requested for requested, _ in server.requests] == [f"{path}?version=1"] * 2


def test_the_time_limit_covers_the_resolution_of_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    answered = threading.Event()
    monkeypatch.setattr(socket, "getaddrinfo", lambda *host, **options: answered.wait(10.0) and [])
    start = time.monotonic()
    proposal = ServerPlanner(ServerConfig(url="http://host.invalid/v1", timeout_s=0.2)).propose(plan_request())
    took = time.monotonic() - start
    waiting = [one for one in threading.enumerate() if one.name == "name resolution"]
    answered.set()
    assert proposal.finish_reason == protocol.TIMEOUT
    assert took < 5.0
    assert [one.daemon for one in waiting] == [True], "the end of the program does not wait for it"


def test_a_host_that_cannot_be_resolved_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*host: object, **options: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    proposal = ServerPlanner(ServerConfig(url="http://host.invalid/v1", timeout_s=5.0)).propose(plan_request())
    assert proposal.finish_reason.startswith("error: no connection to http://host.invalid/v1")
    assert "Name or service not known" in proposal.finish_reason


def test_an_address_without_a_server_is_an_error() -> None:
    with serve(silence) as server:
        url = server.url
    proposal = ServerPlanner(ServerConfig(url=url, timeout_s=2.0)).propose(plan_request())
    assert proposal.finish_reason.startswith(f"error: no connection to {url}")


@pytest.mark.parametrize(
    "url",
    [
        "ftp://host/v1",
        "file:///etc/passwd",
        "http://",
        "host:80/v1",
        "http://host:99999999/v1",
        "http://host/v\xe9",
        "http://host/v1?a=\xe9",
        "http://host/v 1",
        "http://x..y/v1",
        "http://a b/v1",
        f"http://{'x' * 64}/v1",
    ],
)
def test_an_invalid_address_is_refused(url: str) -> None:
    with pytest.raises(ConfigurationError, match="https://HOST"):
        ServerPlanner(ServerConfig(url=url))


@pytest.mark.parametrize(
    "url",
    [
        "ftp://user:pa55word@host/v1?key=pa55word",
        "http://user:pa55/word@host/v1",
        "http://user:pa55word@host:99999999/v1",
        "http://user:pa55word@x..y/v1",
    ],
)
def test_the_refusal_of_an_address_shows_no_password(url: str) -> None:
    with pytest.raises(ConfigurationError, match="https://HOST") as raised:
        ServerPlanner(ServerConfig(url=url))
    assert "pa55" not in f"{raised.value!r} {vars(raised.value)} {raised.value.__context__!r}"


def test_international_and_numeric_hosts_are_accepted() -> None:
    for url in ("http://b\xfccher.example/v1", "http://[::1]:80/v1", "https://host./v1"):
        ServerPlanner(ServerConfig(url=url))
    assert "secret" not in repr(ServerConfig(url=url, key="sk-secret of ours"))


@pytest.mark.parametrize(
    "host", ["lan-server:8000", "10.0.0.7", "[fd00::1]", "localhost.evil.example", "127.0.0.1.nip.io"]
)
def test_a_key_is_not_sent_over_unencrypted_http(host: str) -> None:
    with pytest.raises(ConfigurationError, match="https") as raised:
        ServerPlanner(ServerConfig(url=f"http://{host}/v1", key="sk-secret"))
    assert "secret" not in str(raised.value)
    ServerPlanner(ServerConfig(url=f"http://{host}/v1"))
    ServerPlanner(ServerConfig(url=f"https://{host}/v1", key="sk-secret"))


@pytest.mark.parametrize("host", ["localhost:8000", "LOCALHOST", "127.0.0.1", "127.9.9.9:1", "[::1]:80"])
def test_a_key_may_be_sent_over_http_on_this_machine(host: str) -> None:
    ServerPlanner(ServerConfig(url=f"http://{host}/v1", key="sk-secret"))


@pytest.mark.parametrize("stray", ["\r", "\n", "\r\n", "\t", "\0", "\xe9", "\u2028"])
def test_an_invalid_key_is_refused_and_not_shown(stray: str) -> None:
    with pytest.raises(ConfigurationError, match="printable ASCII") as raised:
        ServerPlanner(ServerConfig(url="http://host/v1", key=f"sk-secret{stray}"))
    assert "secret" not in f"{raised.value!r} {vars(raised.value)} {raised.value.__context__!r}"


@pytest.mark.parametrize(
    ("path", "key", "finish"),
    [
        ("/v1", "sk-secret\r", "LocalProtocolError"),
        ("/v1", "sk-secret\u20ac", "UnicodeEncodeError"),
        ("/v1\0", "sk-secret", "InvalidURL"),
    ],
)
def test_a_request_that_cannot_be_sent_is_an_error_without_the_key(path: str, key: str, finish: str) -> None:
    with serve(respond_with(chat_completion(CONTRACT))) as server:
        url = server.url.removesuffix("/v1") + path
        assert http_chat.post(url, b"", key=key, timeout_s=5.0) == http_chat.ChatResponse(
            text="", finish_reason=protocol.ERROR, detail=f"the request could not be sent ({finish})"
        )
    assert not server.requests


def test_a_key_that_a_server_repeats_is_not_recorded() -> None:
    proposal, server = ask(respond_with(b'{"error":"no such key: sk-secret!"}', 401), model="m", key="sk-secret")
    assert server.headers[0]["Authorization"] == "Bearer sk-secret"
    assert proposal.finish_reason == (
        'error: status 401. The server requires a valid key: set OPENAI_API_KEY. {"error":"no such key: [key]!"}'
    )
    assert "secret" not in repr(proposal)


@pytest.mark.parametrize("url", ["http://x..y/v1", "http://a b/v1", "http://host:port/v1"])
def test_an_invalid_host_is_an_error(url: str) -> None:
    answer = http_chat.post(url, b"", key="sk-secret", timeout_s=5.0)
    assert isinstance(answer, http_chat.ChatResponse)
    assert (answer.finish_reason, "secret" in answer.detail) == (protocol.ERROR, False)


def test_an_unknown_dialect_lists_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match="vllm"):
        ServerPlanner(ServerConfig(url="http://host/v1", dialect="vlm"))


@given(body=st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_no_bytes_raise_in_the_parsers(body: bytes) -> None:
    assert isinstance(http_chat.parse_completion(body), http_chat.ChatResponse)
    assert isinstance(ollama.parse_chat(body), http_chat.ChatResponse)
