"""One request to a chat server over HTTP with a total time limit, and parsing of the response.

No failure of a server raises: silence, errors and malformed responses are returned as values. So is a request that
cannot be sent, with the type of the error only, because its text might contain the key. Proxies and redirects are not
followed, so that a key is sent to the named host only. `post` removes the key from everything that it returns. All
processing of a response takes time proportional to its length.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Coroutine, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit, urlunsplit

from dualbrain.core.lazy_exports import missing_dependency
from dualbrain.core.processes.event_loop import run_with_time_limits
from dualbrain.planner import protocol
from dualbrain.planner.backends.key_redaction import KeyRedactor, public_address

MAX_RESPONSE_BYTES = 1 << 20
"""Largest size of an HTTP response that is read [bytes]; a longer response is an error."""
FENCE = "```"
"""Begins and ends a code block in Markdown."""

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


def append_path(url: str, path: str, *, replaces: str = "") -> str:
    """`url` with `path` after its own path, in place of `replaces` at the end of that; a query stays behind it."""
    address = urlsplit(url)
    return urlunsplit(address._replace(path=address.path.rstrip("/").removesuffix(replaces) + path))


def request_completion(
    url: str,
    body: dict[str, Any],
    *,
    key: str,
    timeout_s: float,
    parse: Callable[[bytes], ChatResponse] | None = None,
    remedies: Mapping[int, str] = {},
) -> ChatResponse:
    """POST `body` to `url` and `parse` the response (default: `parse_completion`), all within `timeout_s` [s].

    `remedies` replace the usual ones for HTTP statuses.
    """
    reply = post(url, json.dumps(body).encode(), key=key, timeout_s=timeout_s)
    if isinstance(reply, ChatResponse):
        return reply
    status, data = reply
    if status != 200:
        return _error(_describe_status(status, excerpt(data), remedies))
    return (parse or parse_completion)(data)


def parse_completion(data: bytes) -> ChatResponse:
    """The first choice of an OpenAI-style chat completion."""
    try:
        completion = json.loads(data)
        choice = completion["choices"][0]
        message = choice["message"]
        content, refusal, finish = message.get("content"), message.get("refusal"), choice.get("finish_reason")
    except (ValueError, RecursionError, LookupError, TypeError, AttributeError):
        return _error("the response is not a chat completion")
    metrics, build = _parse_metrics(completion), _parse_build(completion)
    if refusal or finish == "content_filter":
        return ChatResponse(
            text="", finish_reason=protocol.REFUSAL, detail=excerpt_value(refusal or finish), metrics=metrics
        )
    if not isinstance(content, str) or not isinstance(finish, str):
        return ChatResponse(text="", finish_reason=protocol.ERROR, detail="the response has no text", metrics=metrics)
    if finish in _TRUNCATED_REASONS:
        return ChatResponse(text=content, finish_reason=protocol.LENGTH, metrics=metrics, server_build=build)
    if finish not in _COMPLETE_REASONS:
        return ChatResponse(
            text="", finish_reason=protocol.ERROR, detail=f"finish reason {excerpt(finish)}", metrics=metrics
        )
    return ChatResponse(text=content, finish_reason=protocol.STOP, metrics=metrics, server_build=build)


def strip_fence(text: str) -> tuple[str, bool]:
    """`text` without the Markdown code fence around it, and whether there was one."""
    block = text.strip()
    if len(block) < 2 * len(FENCE) or not (block.startswith(FENCE) and block.endswith(FENCE)):
        return text, False
    language, line_end, body = block.removeprefix(FENCE).removesuffix(FENCE).partition("\n")
    language = language.rstrip()
    if not line_end or (language and not (language.isascii() and language.isalpha())):
        return text, False
    blank = body[: len(body) - len(body.lstrip())]
    return body[blank.rfind("\n") + 1 :].rstrip(), True


def post(url: str, data: bytes, *, key: str, timeout_s: float) -> tuple[int, bytes] | ChatResponse:
    """Status and body of the response, or the reason why there is none; neither contains the key (`KeyRedactor`).

    `timeout_s` [s] limits the whole exchange, even if the server still sends single bytes.
    """
    redactor = KeyRedactor(key)
    reply = _post(url, data, redactor, key=key, timeout_s=timeout_s)
    return reply if isinstance(reply, ChatResponse) else (reply[0], redactor.redact_body(reply[1]))


def _post(
    url: str, data: bytes, redactor: KeyRedactor, *, key: str, timeout_s: float
) -> tuple[int, bytes] | ChatResponse:
    if timeout_s <= 0:
        return ChatResponse(text="", finish_reason=protocol.TIMEOUT)
    try:
        import httpx  # noqa: PLC0415  (an extra, and slow to import)
    except ModuleNotFoundError as error:
        raise missing_dependency(error, "a chat server") from error
    try:
        return _run(_exchange(url, data, key, timeout_s))
    except (TimeoutError, httpx.TimeoutException):
        return ChatResponse(text="", finish_reason=protocol.TIMEOUT)
    except httpx.ConnectError as error:
        fix = "Is the server running, and is its address right? It is the part of --planner before the #."
        reason, address = (redactor.redact_text(one) for one in (str(error), public_address(url)))
        return _error(f"no connection to {address}: {excerpt(reason)}. {fix}")
    except (httpx.RemoteProtocolError, httpx.ReadError, httpx.WriteError):
        return _error("the server closed the connection before the end of its response")
    except (httpx.HTTPError, httpx.InvalidURL, ValueError) as error:  # the text might contain the key
        return _error(f"the request could not be sent ({type(error).__name__})")


async def _exchange(url: str, data: bytes, key: str, timeout_s: float) -> tuple[int, bytes] | ChatResponse:
    """Send the request and read at most `MAX_RESPONSE_BYTES` of the response, within `timeout_s` [s]."""
    import httpx  # noqa: PLC0415

    headers = {"Content-Type": "application/json", "Accept-Encoding": "identity"}
    headers |= {"Authorization": f"Bearer {key}"} if key else {}
    encrypted = url.startswith("https:")  # the creation of a TLS context takes some 20 ms
    async with (
        asyncio.timeout(timeout_s),
        httpx.AsyncClient(timeout=None, verify=encrypted, trust_env=False, follow_redirects=False) as client,
        client.stream("POST", url, content=data, headers=headers) as reply,
    ):
        body = bytearray()
        async for chunk in reply.aiter_raw():
            body += chunk
            if len(body) > MAX_RESPONSE_BYTES:
                return _error(f"the response is longer than {MAX_RESPONSE_BYTES} bytes")
        return reply.status_code, bytes(body)


def _run(exchange: Coroutine[Any, Any, tuple[int, bytes] | ChatResponse]) -> tuple[int, bytes] | ChatResponse:
    """The result of `exchange`, also in a thread with a running event loop, such as that of a notebook."""
    try:
        asyncio.get_running_loop()
    except RuntimeError:
        return run_with_time_limits(exchange)
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(run_with_time_limits, exchange).result()


def _error(detail: str) -> ChatResponse:
    return ChatResponse(text="", finish_reason=protocol.ERROR, detail=detail)


def _describe_status(status: int, body: str, special: Mapping[int, str]) -> str:
    """Detail of a response whose status is not 200, with the usual remedy."""
    remedies = {
        401: "The server requires a valid key: set OPENAI_API_KEY.",
        403: "The server refuses this key: check OPENAI_API_KEY.",
        404: "Check the address, which often ends in /v1, and the model after #.",
        429: "The server limits requests: try again later.",
        **special,
    }
    remedy = remedies.get(status, "The server failed: see its log." if status >= 500 else "")
    return " ".join(filter(None, (f"status {status}.", remedy, body)))


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


def excerpt_value(value: object) -> str:
    """The excerpt of a text; of any other value only its type, because it may be nested too deeply to be printed."""
    return excerpt(value) if isinstance(value, str) else f"of type {type(value).__name__}"
