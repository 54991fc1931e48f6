"""Unconstrained completion by the serving runtime, with the margin of each token."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from dualbrain.planner import protocol
from dualbrain.planner.backends.http_chat import ChatResponse
from dualbrain.planner.backends.llama_cpp import LlamaPlanner

ChatTurns = Sequence[dict[str, str]]


@dataclass(frozen=True, slots=True)
class RawCompletion:
    """An unconstrained answer. `is_complete` unless it was cut; `tokens` are its ids.

    `margins` [nats] are the differences of log-probability between each token and the best alternative: 0 is a tie that
    any rounding may decide.
    """

    text: str
    is_complete: bool
    tokens: tuple[int, ...]
    margins: tuple[float, ...]


def complete(planner: LlamaPlanner, turns: ChatTurns, *, max_tokens: int) -> RawCompletion | ChatResponse:
    """The greedy unconstrained answer to the chat `turns` in at most `max_tokens` tokens, or why there is none."""
    body = {"messages": list(turns), "max_tokens": max_tokens, "temperature": 0.0, "logprobs": True, "top_logprobs": 2}
    answer = planner.post_json("/v1/chat/completions", body)
    if isinstance(answer, ChatResponse):
        return answer
    try:
        choice = answer["choices"][0]
        steps: list[dict[str, Any]] = (choice.get("logprobs") or {}).get("content") or []
        text, is_complete = str(choice["message"].get("content") or ""), choice["finish_reason"] == "stop"
        tokens = tuple(int(one["id"]) for one in steps)
        return RawCompletion(text, is_complete, tokens, tuple(_margin(one) for one in steps))
    except (LookupError, TypeError, AttributeError, ValueError):
        return ChatResponse(text="", finish_reason=protocol.ERROR, detail="not a chat completion")


def runtime_name(base: Path) -> str:
    """Name and build of the runtime, with the model file, whose quantisation decides near-ties."""
    return f"llama.cpp, xllamacpp {version('xllamacpp')}, {base.name}"


def _margin(step: dict[str, Any]) -> float:
    """Log-probability of the chosen token minus that of the best other one [nats]; negative if another was better."""
    others = [float(one["logprob"]) for one in step["top_logprobs"] if one["id"] != step["id"]]
    return float(step["logprob"]) - max(others, default=-math.inf)
