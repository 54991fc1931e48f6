"""One question to the serving runtime with nothing that binds the answer, and how sure each of its tokens was."""

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
    """A free answer. `whole` unless it was cut; `tokens` are its ids.

    `margins` [nats] say by how much the logarithm of each token's probability was above that of the next best: 0 is a
    tie, which any rounding may turn.
    """

    text: str
    is_complete: bool
    tokens: tuple[int, ...]
    margins: tuple[float, ...]

    @property
    def min_margin(self) -> float:
        """The smallest of its margins [nats]."""
        return min(self.margins, default=math.inf)


def complete(planner: LlamaPlanner, turns: ChatTurns, *, max_tokens: int) -> RawCompletion | ChatResponse:
    """The greedy free answer to the chat `turns` in at most `longest` tokens, or why there is none."""
    body = {"messages": list(turns), "max_tokens": max_tokens, "temperature": 0.0, "logprobs": True, "top_logprobs": 2}
    told = planner.post_json("/v1/chat/completions", body)
    if isinstance(told, ChatResponse):
        return told
    try:
        choice = told["choices"][0]
        steps: list[dict[str, Any]] = (choice.get("logprobs") or {}).get("content") or []
        text, whole = str(choice["message"].get("content") or ""), choice["finish_reason"] == "stop"
        return RawCompletion(text, whole, tuple(int(one["id"]) for one in steps), tuple(_margin(one) for one in steps))
    except (LookupError, TypeError, AttributeError, ValueError):
        return ChatResponse(text="", finish_reason=protocol.ERROR, detail="not a chat completion")


def runtime_name(base: Path) -> str:
    """What serves, by name and build, with the file whose quantisation decides near-ties."""
    return f"llama.cpp, xllamacpp {version('xllamacpp')}, {base.name}"


def _margin(step: dict[str, Any]) -> float:
    """How far the token that was taken stands above the best other [nats]; negative if it was not the best."""
    others = [float(one["logprob"]) for one in step["top_logprobs"] if one["id"] != step["id"]]
    return float(step["logprob"]) - max(others, default=-math.inf)
