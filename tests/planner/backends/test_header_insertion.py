"""Proposals of llama.cpp with the local full prompt: the text of the model with id and context, however it ends.

A server that divides text into single bytes takes the place of the model.
"""

import json
import sys
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any, cast

import pytest

from dualbrain.adaptation.serving import open_planner as open_planner_module
from dualbrain.adaptation.serving.open_planner import planner_provenance
from dualbrain.planner import protocol, registry
from dualbrain.planner.backends import llama_cpp
from dualbrain.planner.backends.llama_cpp import LlamaConfig, LlamaPlanner
from dualbrain.planner.backends.llama_process import LlamaProcess
from dualbrain.planner.introspection import planner_messages
from dualbrain.planner.prompt.prompt_format import FULL_PROMPT, LOCAL_FULL_PROMPT, PromptFormat
from dualbrain.records import Proposal
from tests.planner.backends.fake_chat_server import Behaviour, FakeServer, chat_completion, respond_with, serve
from tests.planner.sample_requests import plan_request

HEADER = FULL_PROMPT.answer_prefix(plan_request())
ACTIONS = '[{"skill":"grasp","params":{"object":"red_cube","speed":0.2}}]}'
FORMATS = {"local": LOCAL_FULL_PROMPT, "full": FULL_PROMPT}
IDLE_MS = {"prompt_ms": 1.0, "predicted_ms": 1.0, "cache_n": 0}


class Worker:
    """A worker that is ready, at the address of a server."""

    key, is_ready, pid, state, loaded_file = "key", True, 1, None, None

    def __init__(self, address: str) -> None:
        self._address = address

    def wait_for_address(self, timeout_s: float) -> tuple[str, None]:
        return self._address, None

    def has_exited(self) -> bool:
        return False

    def close(self) -> None:
        """Nothing to close."""


def byte_tokens(text: str) -> list[dict[str, Any]]:
    return [{"id": byte, "piece": [byte]} for byte in text.encode()]


def byte_model(prefix: str, answer: str) -> Behaviour:
    """A model that writes `answer` after `prefix`, one byte for each request."""

    def behave(call: BaseHTTPRequestHandler) -> None:
        path, body = cast(FakeServer, call.server).requests[-1]
        if path == "/apply-template":
            reply: dict[str, Any] = {"prompt": "\n".join(one["content"] for one in body["messages"])}
        elif path == "/tokenize":
            tokens = byte_tokens(body["content"])
            reply = {"tokens": tokens if body.get("with_pieces") else [one["id"] for one in tokens]}
        else:
            written = bytes(body["prompt"]).rpartition(prefix.encode())[2]
            wanted = answer.encode()[len(written)]
            best = [{"id": wanted, "bytes": [wanted]}]
            reply = {"timings": IDLE_MS, "completion_probabilities": [{"top_logprobs": best}]}
        respond_with(json.dumps(reply).encode())(call)

    return behave


@pytest.fixture
def propose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Proposal, list[str]]]:
    """Asks a planner whose worker behaves as given; returns its proposal, and the texts that it showed."""
    pytest.importorskip("llguidance")
    monkeypatch.setattr(llama_cpp, "find_spec", lambda name: sys)
    (tmp_path / "m.gguf").write_bytes(b"GGUF")

    def ask(behaviour: Behaviour, form: PromptFormat, **config: Any) -> tuple[Proposal, list[str]]:
        with serve(behaviour) as server:
            worker = cast(LlamaProcess, Worker(server.url.removesuffix("/v1")))
            monkeypatch.setattr(LlamaPlanner, "_start", lambda self: worker)
            settings = LlamaConfig(**({"timeout_s": 20.0} | config))
            planner = LlamaPlanner("m", tmp_path / "m.gguf", settings, prompt_format=form)
            shown: list[str] = []
            planner.show_answers(shown.append)
            return planner.propose(plan_request()), shown

    return ask


@pytest.mark.parametrize("form", FORMATS.values(), ids=FORMATS)
def test_forced_text_and_choices_follow_the_header_in_proposal_and_display(propose: Any, form: PromptFormat) -> None:
    proposal, shown = propose(byte_model(form.answer_prefix(plan_request()), ACTIONS), form)
    assert (proposal.finish_reason, proposal.text) == (protocol.STOP, HEADER + ACTIONS)
    assert shown
    assert all(proposal.text.startswith(one) and one.startswith(HEADER) for one in shown)
    assert proposal.constrained_by.endswith(form.header_note)


@pytest.mark.parametrize("form", FORMATS.values(), ids=FORMATS)
@pytest.mark.parametrize("jump_forward", [True, False])
def test_an_answer_that_is_cut_has_the_header(propose: Any, form: PromptFormat, jump_forward: bool) -> None:
    prefix = form.answer_prefix(plan_request())
    cut = respond_with(chat_completion(prefix + ACTIONS[:20], "length"))
    behaviour = byte_model(prefix, ACTIONS) if jump_forward else cut
    proposal, _ = propose(behaviour, form, jump_forward=jump_forward, max_tokens=20)
    assert proposal.finish_reason == protocol.LENGTH
    assert proposal.text.startswith(HEADER + ACTIONS[:20])
    assert (HEADER + ACTIONS).startswith(proposal.text)
    assert len(proposal.text) < len(HEADER + ACTIONS)


@pytest.mark.parametrize("form", FORMATS.values(), ids=FORMATS)
def test_an_answer_that_is_decoded_token_by_token_has_the_header(propose: Any, form: PromptFormat) -> None:
    whole = respond_with(chat_completion(form.answer_prefix(plan_request()) + ACTIONS))
    proposal, _ = propose(whole, form, jump_forward=False)
    assert (proposal.finish_reason, proposal.text) == (protocol.STOP, HEADER + ACTIONS)


@pytest.mark.parametrize("text", ["words", "", "{}", '{"action_sequence":', '{"action_sequence":3}', ACTIONS])
def test_an_answer_outside_the_grammar_is_an_error_without_text(propose: Any, text: str) -> None:
    proposal, _ = propose(respond_with(chat_completion(text)), LOCAL_FULL_PROMPT, jump_forward=False)
    assert (proposal.finish_reason, proposal.text) == ("error: the grammar was not applied", "")


@pytest.mark.parametrize("jump_forward", [True, False])
def test_a_timeout_has_no_text(propose: Any, jump_forward: bool) -> None:
    proposal, _ = propose(
        lambda call: cast(FakeServer, call.server).closing.wait(5.0),
        LOCAL_FULL_PROMPT,
        jump_forward=jump_forward,
        timeout_s=0.3,
    )
    assert (proposal.finish_reason, proposal.text) == (protocol.TIMEOUT, "")


def test_only_servers_and_free_decoding_have_whole_contracts_in_the_prompt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = tmp_path / "m.gguf"
    weights.write_bytes(b"GGUF")
    monkeypatch.setattr(llama_cpp, "find_spec", lambda name: sys)
    monkeypatch.setattr(LlamaPlanner, "_start", lambda self: Worker(""))
    for module in (open_planner_module, registry):
        monkeypatch.setattr(module, "locate_weights", lambda name, cache: weights)
    local = [registry.open_planner(name, tmp_path) for name in (str(weights), registry.DEFAULT_PLANNER)]
    whole = [
        registry.open_planner("http://localhost:8000/v1#qwen", tmp_path),
        open_planner_module.open_unconstrained(registry.DEFAULT_PLANNER, tmp_path, adapters=tmp_path),
    ]
    for planners, form in ((local, LOCAL_FULL_PROMPT), (whole, FULL_PROMPT)):
        for planner in planners:
            shown = planner_messages(planner, plan_request())[: len(form.messages(plan_request()))]
            assert shown == form.messages(plan_request())
            assert planner_provenance(planner) == {"prompt": form.template_hash()}


def test_the_model_reads_no_id_and_no_context(propose: Any) -> None:
    prompts: list[str] = []
    model = byte_model(LOCAL_FULL_PROMPT.answer_prefix(plan_request()), ACTIONS)

    def behave(call: BaseHTTPRequestHandler) -> None:
        path, body = cast(FakeServer, call.server).requests[-1]
        if path == "/completion":
            prompts.append(bytes(body["prompt"]).decode())
        model(call)

    propose(behave, LOCAL_FULL_PROMPT)
    assert prompts
    for fixed in (plan_request().contract_id, plan_request().registry_hash, '"context"'):
        assert all(fixed not in one for one in prompts)
