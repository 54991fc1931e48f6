"""Planner for servers with the OpenAI chat API: vLLM, llama.cpp, Ollama, a hosted model.

The constraint that a server promises for its answers is recorded but not trusted: the gate checks every contract.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

from dualbrain.core.untrusted.loopback import is_loopback
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.planner import protocol
from dualbrain.planner.backends.http_chat import (
    ChatResponse,
    append_path,
    parse_completion,
    request_completion,
    strip_fence,
)
from dualbrain.planner.backends.image_message import (
    IMAGE_REMEDY,
    IMAGE_STATUSES,
    announce_image,
    attach_image,
    attach_image_to_message,
)
from dualbrain.planner.backends.key_redaction import public_address
from dualbrain.planner.backends.ollama import chat_body, chat_url, parse_chat
from dualbrain.planner.camera_image import CameraImage
from dualbrain.planner.decoding.gbnf_schema import replace_text_patterns
from dualbrain.planner.decoding.llguidance_grammar import contract_grammar, strip_annotations
from dualbrain.planner.prompt.full_prompt import ChatMessage
from dualbrain.planner.prompt.prompt_format import FULL_PROMPT, SHORT_PROMPT
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal


@dataclass(frozen=True, slots=True)
class Dialect:
    """How one kind of server receives schema and image, and the name of its constraint in records."""

    constrained_by: str
    constraint: Callable[[dict[str, Any]], dict[str, Any]]
    attach: Callable[[list[ChatMessage], CameraImage], list[dict[str, Any]]] = attach_image


def _response_format(schema: dict[str, Any]) -> dict[str, Any]:
    json_schema = {"name": "contract", "strict": True, "schema": schema}
    return {"response_format": {"type": "json_schema", "json_schema": json_schema}}


OLLAMA = "ollama"
DIALECTS = {
    "openai": Dialect(
        "response_format json_schema (strict)", lambda schema: _response_format(strip_annotations(schema))
    ),
    "vllm": Dialect(
        "structured_outputs json (vLLM, its choice of engine)",
        lambda schema: {"structured_outputs": {"json": strip_annotations(schema, prefix_items=True)}},
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
        "format (Ollama, numeric bounds not enforced)",
        lambda schema: {"format": replace_text_patterns(schema)},
        attach_image_to_message,
    ),
    "free": Dialect("nothing (free decoding)", lambda schema: {}),
}
"""`openai` works with nearly all servers. `vllm` is for version 0.12 and later, which removed the older `guided_json`.
`llguidance` is for a llama.cpp server built with this engine, which enforces numeric bounds; without the engine the
server reports an error. `free` requests no constraint, to measure a model without one."""


PROMPTS = {"full": FULL_PROMPT, "short": SHORT_PROMPT}
"""`full` states rules, skills and examples; `short` is the prompt on which adapters are trained."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerConfig:
    """Address and settings: `url` up to and including `/v1`, the server's name of the model, total `timeout_s` [s]."""

    url: str
    model: str = "default"
    key: str = field(default="", repr=False)
    dialect: str = "openai"
    prompt: str = "full"
    """One of `PROMPTS`: `full` for a model that was not adapted, `short` for one with an adapter of dualbrain."""
    max_tokens: int = 800
    timeout_s: float = 120.0
    languages: tuple[str, ...] = ()
    """Languages of instructions that the model reads, as ISO 639-1 codes ("*": all); English if none is declared."""


class ServerPlanner:
    """Proposes with the model of the server at `config.url`; needs only the standard library.

    Raises `ConfigurationError` for an address or a key that cannot be used, and `UnknownNameError` for an unknown
    dialect or prompt.
    """

    def __init__(self, config: ServerConfig, *, clock: Callable[[], float] = time.monotonic) -> None:
        _require_address(config.url)
        _require_key(config.key)
        _require_https_for_key(config)
        if config.dialect not in DIALECTS:
            raise UnknownNameError("dialect", config.dialect, tuple(DIALECTS))
        if config.prompt not in PROMPTS:
            raise UnknownNameError("prompt of a server", config.prompt, tuple(PROMPTS))
        self._config, self._clock, self._dialect = config, clock, DIALECTS[config.dialect]
        self._prompt = PROMPTS[config.prompt]

    @property
    def name(self) -> str:
        """Model and host; never the key."""
        return f"{self._config.model}@{urlsplit(self._config.url).hostname}"

    @property
    def languages(self) -> tuple[str, ...]:
        """The declared languages of instructions; empty: English."""
        return self._config.languages

    @property
    def takes_images(self) -> bool:
        """True: the image of a request is sent. A server whose model takes none answers with an error."""
        return True

    @property
    def template(self) -> str:
        """Hash of the fixed text in the prompt."""
        return self._prompt.template_hash()

    @property
    def dialect(self) -> str:
        """The dialect, which names the expected kind of server."""
        return self._config.dialect

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`; a failure of the server becomes the finish reason.

        The time limit includes the processing of the response: a contract that is complete only later is a timeout.
        """
        start = self._clock()
        is_ollama = self._config.dialect == OLLAMA
        url = chat_url(self._config.url) if is_ollama else append_path(self._config.url, "/chat/completions")
        response = request_completion(
            url,
            self._body(request),
            key=self._config.key,
            timeout_s=self._config.timeout_s,
            parse=parse_chat if is_ollama else parse_completion,
            remedies=dict.fromkeys(IMAGE_STATUSES, IMAGE_REMEDY) if request.image else {},
        )
        proposal = self._proposal(response, self._clock() - start)
        if self._clock() - start <= self._config.timeout_s:
            return proposal
        return self._proposal(ChatResponse(text="", finish_reason=protocol.TIMEOUT), self._clock() - start)

    def close(self) -> None:
        """Do nothing: no resource is open."""

    def messages(self, request: PlanRequest) -> list[ChatMessage]:
        """The text of the messages for `request`; the last one announces the image, if there is one."""
        messages = self._prompt.messages(request)
        return announce_image(messages) if request.image else messages

    def _body(self, request: PlanRequest) -> dict[str, Any]:
        constraint = self._dialect.constraint(request.schema)
        messages = self.messages(request)
        sent = self._dialect.attach(messages, request.image) if request.image else messages
        if self._config.dialect == OLLAMA:
            return chat_body(self._config.model, sent, self._config.max_tokens, constraint["format"])
        seed = self._prompt.sampling_seed(request)
        sampling = {"temperature": 0.0, "seed": 0} if seed is None else {"temperature": 1.0, "seed": seed}
        limits = {"max_tokens": self._config.max_tokens, "stream": False} | sampling
        return {"model": self._config.model, "messages": sent} | limits | constraint

    def _proposal(self, response: ChatResponse, total: float) -> Proposal:
        text, fenced = strip_fence(response.text)
        constrained_by = self._dialect.constrained_by + (f"; {response.server_build}" if response.server_build else "")
        constrained_by += "; code fence stripped" if fenced else ""
        detail = f": {response.detail}" if response.detail else ""
        return Proposal(
            text=text,
            finish_reason=response.finish_reason + detail,
            planner=self.name,
            constrained_by=constrained_by,
            timings={**response.metrics, "total": total},
        )


def _require_address(url: str) -> None:
    try:
        address = urlsplit(url)
        host = (address.hostname or "").encode("idna").decode()  # as sockets encode it
        printable = re.fullmatch("[!-~]+", host) and re.fullmatch("[!-~]*", address.path + address.query)
        valid = address.scheme in {"http", "https"} and bool(printable) and (address.port or 1) > 0
    except ValueError:
        valid = False
    if not valid:
        allowed = "http://HOST[:PORT]/v1 or https://HOST[:PORT]/v1, the path in printable ASCII (é as %C3%A9)"
        raise ConfigurationError("planner address", got=public_address(url), allowed=allowed)


def _require_https_for_key(config: ServerConfig) -> None:
    """Raise `ConfigurationError` for a key that would leave this machine over unencrypted http."""
    address = urlsplit(config.url)
    host = address.hostname or ""
    if config.key and address.scheme == "http" and not is_loopback(host):
        fix = "Use an https address, a tunnel to a port of this machine, or no key (OPENAI_API_KEY=)."
        allowed = "https, or http to this machine"
        raise ConfigurationError("planner address for a key", got=f"http://{host}", allowed=allowed, fix=fix)


def _require_key(key: str) -> None:
    """Raise `ConfigurationError`, without any part of the key, unless the key is printable ASCII."""
    if not re.fullmatch("[ -~]*", key):
        fix = "Set it again; it may have been copied with a line end."
        raise ConfigurationError("planner key", got="other characters (not shown)", allowed="printable ASCII", fix=fix)
