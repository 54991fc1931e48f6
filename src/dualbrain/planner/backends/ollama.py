"""Ollama's native chat API, which takes the schema in `format` and the size of the context in `options`.

Its OpenAI-compatible API takes a schema, too, but silently cuts a prompt that exceeds the small default context; the
native API allows requests to set the context size.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from dualbrain.planner import protocol
from dualbrain.planner.backends.http_chat import ChatResponse, append_path, excerpt_value, parse_count

N_CTX = 8192
"""Size of the context [tokens], enough for the full prompt with exemplars and the longest answer."""
SECONDS_PER_NANOSECOND = 1e-9


def chat_url(url: str) -> str:
    """Address of the native API, which is beside `/v1` of the OpenAI-compatible API."""
    return append_path(url, "/api/chat", replaces="/v1")


def chat_body(
    model: str, messages: Sequence[Mapping[str, Any]], max_tokens: int, schema: dict[str, Any]
) -> dict[str, Any]:
    """Body of a request whose answer must satisfy `schema`."""
    options = {"temperature": 0.0, "seed": 0, "num_predict": max_tokens, "num_ctx": N_CTX}
    return {"model": model, "messages": messages, "stream": False, "format": schema, "options": options}


def parse_chat(data: bytes) -> ChatResponse:
    """The message in a response of Ollama."""
    try:
        reply = json.loads(data)
        content, reason = reply["message"]["content"], reply.get("done_reason")
    except (ValueError, RecursionError, LookupError, TypeError, AttributeError):
        return ChatResponse(text="", finish_reason=protocol.ERROR, detail="not an answer of Ollama")
    metrics = _parse_metrics(reply)
    if not isinstance(content, str) or reply.get("done") is not True:
        return ChatResponse(
            text="", finish_reason=protocol.ERROR, detail="no whole text in the answer", metrics=metrics
        )
    match reason:
        case "stop":
            return ChatResponse(text=content, finish_reason=protocol.STOP, metrics=metrics)
        case "length":
            return ChatResponse(text=content, finish_reason=protocol.LENGTH, metrics=metrics)
        case _:
            return ChatResponse(
                text="", finish_reason=protocol.ERROR, detail=f"finish reason {excerpt_value(reason)}", metrics=metrics
            )


def _parse_metrics(reply: dict[str, Any]) -> dict[str, float]:
    names = {
        "prefill": ("prompt_eval_duration", SECONDS_PER_NANOSECOND),
        "decode": ("eval_duration", SECONDS_PER_NANOSECOND),
        "prompt_tokens": ("prompt_eval_count", 1.0),
        "output_tokens": ("eval_count", 1.0),
    }
    counts = {name: (parse_count(reply.get(key)), scale) for name, (key, scale) in names.items()}
    return {name: value * scale for name, (value, scale) in counts.items() if value is not None}
