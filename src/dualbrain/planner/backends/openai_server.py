"""Any server that speaks the OpenAI chat API: vLLM, llama.cpp, Ollama, a hosted model.

What the server promises about the form of its answer is recorded and never believed: the gate checks every contract.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.planner.backends.http_chat import ChatResponse, parse_completion, request_completion, strip_fence
from dualbrain.planner.backends.ollama import chat_body, chat_url, parse_chat
from dualbrain.planner.decoding.gbnf_schema import replace_text_patterns
from dualbrain.planner.decoding.llguidance_grammar import contract_grammar, strip_annotations
from dualbrain.planner.prompt.full_prompt import render
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal


@dataclass(frozen=True, slots=True)
class Dialect:
    """How one server takes a schema, and what is known of how well it keeps to it."""

    constrained_by: str
    constraint: Callable[[dict[str, Any]], dict[str, Any]]


def _response_format(narrowed: dict[str, Any]) -> dict[str, Any]:
    form = {"name": "contract", "strict": True, "schema": narrowed}
    return {"response_format": {"type": "json_schema", "json_schema": form}}


OLLAMA = "ollama"
DIALECTS = {
    "openai": Dialect(
        "response_format json_schema (strict)", lambda schema: _response_format(strip_annotations(schema))
    ),
    "vllm": Dialect(
        "structured_outputs json (vLLM, its choice of engine)",
        lambda schema: {"structured_outputs": {"json": strip_annotations(schema)}},
    ),
    "llama.cpp": Dialect(
        "response_format json_schema (llama.cpp, numeric bounds not enforced)",
        lambda schema: _response_format(replace_text_patterns(schema)) | {"cache_prompt": True},
    ),
    "llguidance": Dialect(
        "llguidance in llama.cpp (server)",
        lambda schema: {"grammar": contract_grammar(schema), "cache_prompt": True},
    ),
    OLLAMA: Dialect(
        "format (Ollama, numeric bounds not enforced)", lambda schema: {"format": replace_text_patterns(schema)}
    ),
    "free": Dialect("nothing (free decoding)", lambda schema: {}),
}
"""`openai` is understood by nearly all. `vllm` is for 0.12 and later, which dropped the older `guided_json`.
`llguidance` is for a llama.cpp server built with that engine, which keeps numbers in their bounds; one built without
answers with an error. `free` asks for no constraint, to measure what a model does by itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerConfig:
    """Where and how to ask: `url` up to and including `/v1`, `model` as the server calls it, one `timeout_s` [s]."""

    url: str
    model: str = "default"
    key: str = field(default="", repr=False)
    dialect: str = "openai"
    max_tokens: int = 800
    timeout_s: float = 120.0


class ServerPlanner:
    """Proposes by asking the server at `config.url`; needs nothing but the standard library.

    Raises `InvalidSetup` for an address or a key that cannot be sent, `UnknownName` for an unknown dialect.
    """

    def __init__(self, config: ServerConfig, *, clock: Callable[[], float] = time.monotonic) -> None:
        _require_address(config.url)
        _require_key(config.key)
        _require_https_for_key(config)
        if config.dialect not in DIALECTS:
            raise UnknownNameError("dialect", config.dialect, tuple(DIALECTS))
        self._config, self._clock, self._dialect = config, clock, DIALECTS[config.dialect]

    @property
    def name(self) -> str:
        """Model and host; never the key."""
        return f"{self._config.model}@{urlsplit(self._config.url).hostname}"

    @property
    def dialect(self) -> str:
        """Which server it takes for granted."""
        return self._config.dialect

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`; whatever the server does becomes a finish reason."""
        begun = self._clock()
        own = self._config.dialect == OLLAMA
        url = chat_url(self._config.url) if own else f"{self._config.url.rstrip('/')}/chat/completions"
        answer = request_completion(
            url,
            self._body(request),
            key=self._config.key,
            timeout_s=self._config.timeout_s,
            parse=parse_chat if own else parse_completion,
        )
        return self._proposal(answer, self._clock() - begun)

    def close(self) -> None:
        """Nothing is held open."""

    def _body(self, request: PlanRequest) -> dict[str, Any]:
        constraint = self._dialect.constraint(request.schema)
        if self._config.dialect == OLLAMA:
            return chat_body(self._config.model, render(request), self._config.max_tokens, constraint["format"])
        limits = {"max_tokens": self._config.max_tokens, "temperature": 0.0, "seed": 0, "stream": False}
        question = {"model": self._config.model, "messages": render(request)}
        return question | limits | constraint

    def _proposal(self, answer: ChatResponse, total: float) -> Proposal:
        text, fenced = strip_fence(answer.text)
        constrained_by = self._dialect.constrained_by + (f"; {answer.server_build}" if answer.server_build else "")
        constrained_by += "; code fence stripped" if fenced else ""
        finish = f"{answer.finish_reason}: {answer.detail}" if answer.detail else answer.finish_reason
        return Proposal(
            text=text,
            finish_reason=finish,
            planner=self.name,
            constrained_by=constrained_by,
            timings={**answer.metrics, "total": total},
        )


def _require_address(url: str) -> None:
    try:
        address = urlsplit(url)
        host = (address.hostname or "").encode("idna").decode()  # as a socket will
        told = re.fullmatch("[!-~]+", host) and re.fullmatch("[!-~]*", address.path + address.query)
        fine = address.scheme in {"http", "https"} and bool(told) and (address.port or 1) > 0
    except ValueError:
        fine = False
    if not fine:
        allowed = "http://HOST[:PORT]/v1 or https://HOST[:PORT]/v1, the path in printable ASCII (é as %C3%A9)"
        raise ConfigurationError("planner address", got=url, allowed=allowed)


def _require_https_for_key(config: ServerConfig) -> None:
    """A key is not sent where all on the way can read it: over plain http it stays on this machine."""
    address = urlsplit(config.url)
    host = address.hostname or ""
    if config.key and address.scheme == "http" and not _is_loopback(host):
        fix = "Name an https address, lead a tunnel to a port of this machine, or leave the key out (OPENAI_API_KEY=)."
        allowed = "https, or http to this machine"
        raise ConfigurationError(
            "planner address that a key is sent to", got=f"http://{host}", allowed=allowed, fix=fix
        )


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _require_key(key: str) -> None:
    """Raises `InvalidSetup`, in which no part of the key is."""
    if not re.fullmatch("[ -~]*", key):
        fix = "Set it again; a stray line end is easily copied with it."
        raise ConfigurationError("planner key", got="other characters (not shown)", allowed="printable ASCII", fix=fix)
