"""One request to a chat server over HTTP with a total time limit, and parsing of the response.

No failure of a server raises: silence, errors and malformed responses are returned as values. So is a request that
cannot be sent, with the type of the error only, because its text might contain the key. Proxies and redirects are not
followed, so that a key is sent to the named host only.
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
"""Largest size of an HTTP response that is read [bytes]; a longer response is an error."""

_COMPLETE_REASONS = frozenset({"stop", "eos", "eos_token", "end_turn"})
_TRUNCATED_REASONS = frozenset({"length", "max_tokens"})


@dataclass(frozen=True, slots=True, kw_only=True)
class ChatResponse:
    """The response of a server: `finish_reason` is one of `protocol`, `detail` explains an error.

    `metrics` are those that the server reports: prefill [s], decode [s], prompt_tokens, cached_tokens, output_tokens.
    `server_build` is its fingerprint, "" if it sends none.
    """

    text: str
    finish_reason: str
    detail: str = ""
    metrics: dict[str, float] = field(default_factory=dict)
    server_build: str = ""


def request_completion(
    url: str, body: dict[str, Any], *, key: str, timeout_s: float, parse: Callable[[bytes], ChatResponse] | None = None
) -> ChatResponse:
    """POST `body` to `url` and `parse` the response (default: `parse_completion`), all within `timeout_s` [s]."""
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
    metrics, build = _parse_metrics(completion), _parse_build(completion)
    if refusal or finish == "content_filter":
        return ChatResponse(
            text="", finish_reason=protocol.REFUSAL, detail=excerpt(str(refusal or finish)), metrics=metrics
        )
    if not isinstance(content, str) or not isinstance(finish, str):
        return ChatResponse(text="", finish_reason=protocol.ERROR, detail="no text in the answer", metrics=metrics)
    if finish in _TRUNCATED_REASONS:
        return ChatResponse(text=content, finish_reason=protocol.LENGTH, metrics=metrics, server_build=build)
    if finish not in _COMPLETE_REASONS:
        return ChatResponse(
            text="", finish_reason=protocol.ERROR, detail=f"finish reason {excerpt(finish)}", metrics=metrics
        )
    return ChatResponse(text=content, finish_reason=protocol.STOP, metrics=metrics, server_build=build)


def strip_fence(text: str) -> tuple[str, bool]:
    """`text` without the Markdown code fence around it, and whether there was one."""
    fenced = re.fullmatch(r"\s*```[a-zA-Z]*\s*\n(.*?)\n?\s*```\s*", text, flags=re.DOTALL)
    return (fenced.group(1), True) if fenced else (text, False)


def post(url: str, data: bytes, *, key: str, timeout_s: float) -> tuple[int, bytes] | ChatResponse:
    """Status and body of the response, or the reason why there is none.

    After `timeout_s` [s] the socket is shut down, even if the server still sends single bytes.
    """
    if timeout_s <= 0:
        return ChatResponse(text="", finish_reason=protocol.TIMEOUT)
    late, timer = Event(), None
    try:
        with closing(_connection(url, timeout_s)) as connection:
            connection.connect()
            sock = connection.sock  # the connection may release it early
            timer = Timer(timeout_s, _shut_down, (sock, late))
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
    """`data` with the `key` replaced, so that a server that repeats the key does not write it into records."""
    return data.replace(key.encode(), b"[key]") if key else data


def _connection(url: str, timeout_s: float) -> HTTPConnection:
    address = urlsplit(url)
    kind = HTTPSConnection if address.scheme == "https" else HTTPConnection
    return kind(address.hostname or "", address.port, timeout=timeout_s)


def _shut_down(sock: socket.socket, late: Event) -> None:
    late.set()
    with suppress(OSError):  # already closed: no call is blocked on it
        sock.shutdown(socket.SHUT_RDWR)


def _parse_metrics(completion: dict[str, Any]) -> dict[str, float]:
    """Times and token counts: llama.cpp's `timings`, else the `usage` that all servers send."""
    timings, usage = completion.get("timings"), completion.get("usage")
    timings, usage = timings if isinstance(timings, dict) else {}, usage if isinstance(usage, dict) else {}
    reported = {
        "prefill": (timings.get("prompt_ms"), 1e-3),
        "decode": (timings.get("predicted_ms"), 1e-3),
        "prompt_tokens": (usage.get("prompt_tokens"), 1.0),
        "cached_tokens": (timings.get("cache_n"), 1.0),
        "output_tokens": (usage.get("completion_tokens"), 1.0),
    }
    counts = {name: (parse_count(value), scale) for name, (value, scale) in reported.items()}
    return {name: count * scale for name, (count, scale) in counts.items() if count is not None}


def _parse_build(completion: dict[str, Any]) -> str:
    """The fingerprint of program and settings, which some servers send; "" without one."""
    fingerprint = completion.get("system_fingerprint")
    return excerpt(fingerprint)[:40] if isinstance(fingerprint, str) else ""


def parse_count(value: object) -> float | None:
    """`value` if it is a number in [0, 1e12], otherwise None; servers may send anything, such as 400-digit integers."""
    if not isinstance(value, (int, float)) or isinstance(value, bool) or not 0 <= value <= 1e12:
        return None
    return float(value)


def excerpt(data: bytes | str) -> str:
    """The first 120 characters of a server's text in printable ASCII; incomplete characters are escaped, too."""
    text = data if isinstance(data, str) else data[:120].decode("utf-8", "replace")
    return ascii(text[:120])[1:-1]
