"""One question to a chat server over HTTP, with a total time limit, and what its answer says.

Nothing here raises for what a server does: silence, errors and nonsense come back as values. So does a question that
cannot be sent, by the name of its fault only: the words might hold the key. Proxies and redirects are not followed, so
that a key goes to no other host than the one that was named.
"""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, field
from http.client import HTTPConnection, HTTPException, HTTPSConnection
from threading import Event, Timer
from typing import Any
from urllib.parse import urlsplit

from dualbrain.planner import protocol

MAX_RESPONSE_BYTES = 1 << 20
"""Bytes of an HTTP answer that are read; a longer one is an error."""

_COMPLETE_REASONS = frozenset({"stop", "eos", "eos_token", "end_turn"})
_TRUNCATED_REASONS = frozenset({"length", "max_tokens"})


@dataclass(frozen=True, slots=True, kw_only=True)
class ChatResponse:
    """What came back: `finish` is a finish reason of `protocol`, `detail` explains an error.

    `figures` are those that the server told: prefill [s], decode [s], prompt_tokens, cached_tokens, output_tokens.
    `build` is what it says of itself, "" if nothing.
    """

    text: str
    finish_reason: str
    detail: str = ""
    metrics: dict[str, float] = field(default_factory=dict)
    server_build: str = ""


def request_completion(
    url: str, body: dict[str, Any], *, key: str, timeout_s: float, parse: Callable[[bytes], ChatResponse] | None = None
) -> ChatResponse:
    """POST `body` to `url` and `read` a chat completion from the answer, all within `timeout_s`."""
    reply = post(url, json.dumps(body).encode(), key=key, timeout_s=timeout_s)
    if isinstance(reply, ChatResponse):
        return reply
    status, data = reply
    if status != 200:
        return ChatResponse(
            text="", finish_reason=protocol.ERROR, detail=f"status {status} {excerpt(_redact(key, data))}".strip()
        )
    return (parse or parse_completion)(data)


def parse_completion(data: bytes) -> ChatResponse:
    """The first choice of an OpenAI-style chat completion."""
    try:
        completion = json.loads(data)
        choice = completion["choices"][0]
        message = choice["message"]
        content, refusal, finish = message.get("content"), message.get("refusal"), choice.get("finish_reason")
    except (ValueError, RecursionError, LookupError, TypeError, AttributeError):
        return ChatResponse(text="", finish_reason=protocol.ERROR, detail="not a chat completion")
    figures, build = _parse_metrics(completion), _parse_build(completion)
    if refusal or finish == "content_filter":
        return ChatResponse(
            text="", finish_reason=protocol.REFUSAL, detail=excerpt(str(refusal or finish)), metrics=figures
        )
    if not isinstance(content, str) or not isinstance(finish, str):
        return ChatResponse(text="", finish_reason=protocol.ERROR, detail="no text in the answer", metrics=figures)
    if finish in _TRUNCATED_REASONS:
        return ChatResponse(text=content, finish_reason=protocol.LENGTH, metrics=figures, server_build=build)
    if finish not in _COMPLETE_REASONS:
        return ChatResponse(
            text="", finish_reason=protocol.ERROR, detail=f"finish reason {excerpt(finish)}", metrics=figures
        )
    return ChatResponse(text=content, finish_reason=protocol.STOP, metrics=figures, server_build=build)


def strip_fence(text: str) -> tuple[str, bool]:
    """`text` without the Markdown code fence around it, and whether there was one."""
    fenced = re.fullmatch(r"\s*```[a-zA-Z]*\s*\n(.*?)\n?\s*```\s*", text, flags=re.DOTALL)
    return (fenced.group(1), True) if fenced else (text, False)


def post(url: str, data: bytes, *, key: str, timeout_s: float) -> tuple[int, bytes] | ChatResponse:
    """Status and body of the answer, or why there is none.

    At `timeout_s` the socket is shut, however slowly bytes may be dripping in.
    """
    if timeout_s <= 0:
        return ChatResponse(text="", finish_reason=protocol.TIMEOUT)
    late, timer = Event(), None
    try:
        with closing(_connection(url, timeout_s)) as connection:
            connection.connect()
            own = connection.sock  # the connection lets go of it early
            timer = Timer(timeout_s, _shut_down, (own, late))
            timer.daemon = True
            timer.start()
            headers = {"Content-Type": "application/json"} | ({"Authorization": f"Bearer {key}"} if key else {})
            address = urlsplit(url)
            target = f"{address.path}?{address.query}" if address.query else address.path
            connection.request("POST", target, data, headers)
            reply = connection.getresponse()
            status, body = reply.status, reply.read(MAX_RESPONSE_BYTES + 1)
    except TimeoutError:
        return ChatResponse(text="", finish_reason=protocol.TIMEOUT)
    except (OSError, HTTPException, ValueError) as error:
        return (
            ChatResponse(text="", finish_reason=protocol.TIMEOUT)
            if late.is_set()
            else ChatResponse(text="", finish_reason=protocol.ERROR, detail=type(error).__name__)
        )
    finally:
        if timer is not None:
            timer.cancel()
    if late.is_set():
        return ChatResponse(text="", finish_reason=protocol.TIMEOUT)
    if len(body) > MAX_RESPONSE_BYTES:
        return ChatResponse(
            text="", finish_reason=protocol.ERROR, detail=f"answer longer than {MAX_RESPONSE_BYTES} bytes"
        )
    return status, body


def _redact(key: str, data: bytes) -> bytes:
    """`data` in which a server that repeats the `key` does not tell it to those who read the records."""
    return data.replace(key.encode(), b"[key]") if key else data


def _connection(url: str, timeout_s: float) -> HTTPConnection:
    address = urlsplit(url)
    kind = HTTPSConnection if address.scheme == "https" else HTTPConnection
    return kind(address.hostname or "", address.port, timeout=timeout_s)


def _shut_down(sock: socket.socket, late: Event) -> None:
    late.set()
    with suppress(OSError):  # closed already: nobody is waiting on it
        sock.shutdown(socket.SHUT_RDWR)


def _parse_metrics(completion: dict[str, Any]) -> dict[str, float]:
    """Times and token counts: llama.cpp's `timings`, else the `usage` that all servers send."""
    timings, usage = completion.get("timings"), completion.get("usage")
    timings, usage = timings if isinstance(timings, dict) else {}, usage if isinstance(usage, dict) else {}
    told = {
        "prefill": (timings.get("prompt_ms"), 1e-3),
        "decode": (timings.get("predicted_ms"), 1e-3),
        "prompt_tokens": (usage.get("prompt_tokens"), 1.0),
        "cached_tokens": (timings.get("cache_n"), 1.0),
        "output_tokens": (usage.get("completion_tokens"), 1.0),
    }
    counts = {name: (parse_count(value), scale) for name, (value, scale) in told.items()}
    return {name: count * scale for name, (count, scale) in counts.items() if count is not None}


def _parse_build(completion: dict[str, Any]) -> str:
    """The fingerprint of program and settings that some servers send."""
    said = completion.get("system_fingerprint")
    return excerpt(said)[:40] if isinstance(said, str) else ""


def parse_count(value: object) -> float | None:
    """`value` if it is a finite number that is not negative (a server may send anything, 400-digit integers too)."""
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not 0 <= value <= 1e12:
        return None
    return float(value)


def excerpt(data: bytes | str) -> str:
    """The beginning of a server's own words, in printable ASCII; also of half a character, which JSON may bring."""
    words = data if isinstance(data, str) else data[:120].decode("utf-8", "replace")
    return ascii(words[:120])[1:-1]
