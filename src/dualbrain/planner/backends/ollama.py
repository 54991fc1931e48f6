"""Ollama's own chat interface: the schema goes into `format`, the size of the context into `options`.

Its OpenAI-compatible one takes a schema too, but cuts a prompt that is longer than its small default context without a
word; here the context is asked for.
"""

from __future__ import annotations

import json
from typing import Any

from dualbrain.planner import protocol
from dualbrain.planner.backends.http_chat import ChatResponse, excerpt, parse_count
from dualbrain.planner.prompt.full_prompt import ChatMessage

N_CTX = 8192
"""Tokens of context: the full prompt with its exemplars and the longest answer fit."""
SECONDS_PER_NANOSECOND = 1e-9


def chat_url(url: str) -> str:
    """Where it is asked: beside the `/v1` of its other interface."""
    return url.rstrip("/").removesuffix("/v1") + "/api/chat"


def chat_body(model: str, messages: list[ChatMessage], max_tokens: int, schema: dict[str, Any]) -> dict[str, Any]:
    """A question that is to be answered in the form of `schema`."""
    options = {"temperature": 0.0, "seed": 0, "num_predict": max_tokens, "num_ctx": N_CTX}
    return {"model": model, "messages": messages, "stream": False, "format": schema, "options": options}


def parse_chat(data: bytes) -> ChatResponse:
    """The message of its answer."""
    try:
        told = json.loads(data)
        content, reason = told["message"]["content"], told.get("done_reason")
    except (ValueError, RecursionError, LookupError, TypeError, AttributeError):
        return ChatResponse(text="", finish_reason=protocol.ERROR, detail="not an answer of Ollama")
    figures = _parse_metrics(told)
    if not isinstance(content, str) or told.get("done") is not True:
        return ChatResponse(
            text="", finish_reason=protocol.ERROR, detail="no whole text in the answer", metrics=figures
        )
    match reason:
        case "stop":
            return ChatResponse(text=content, finish_reason=protocol.STOP, metrics=figures)
        case "length":
            return ChatResponse(text=content, finish_reason=protocol.LENGTH, metrics=figures)
        case _:
            return ChatResponse(
                text="", finish_reason=protocol.ERROR, detail=f"finish reason {excerpt(str(reason))}", metrics=figures
            )


def _parse_metrics(told: dict[str, Any]) -> dict[str, float]:
    names = {
        "prefill": ("prompt_eval_duration", SECONDS_PER_NANOSECOND),
        "decode": ("eval_duration", SECONDS_PER_NANOSECOND),
        "prompt_tokens": ("prompt_eval_count", 1.0),
        "output_tokens": ("eval_count", 1.0),
    }
    found = {name: (parse_count(told.get(key)), scale) for name, (key, scale) in names.items()}
    return {name: value * scale for name, (value, scale) in found.items() if value is not None}
