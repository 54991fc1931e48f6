"""Perplexity of a given text in the serving runtime: the measure of the general language that an adapter retains.

llama.cpp reports no probabilities of a prompt. A grammar that admits only the text makes the model generate it, and the
reported probabilities are those before the grammar: exp(−1/n Σ_t log p(token_t | before)). The split of the text into
tokens is the model's own greedy choice.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

from dualbrain.planner.backends.http_chat import ChatResponse
from dualbrain.planner.backends.llama_cpp import LlamaPlanner


def retention_text() -> str:
    """A fixed plain-English text that is unrelated to robots, written for this measurement."""
    return Path(__file__).with_name("perplexity_text.txt").read_text("utf-8")


def perplexity(planner: LlamaPlanner, text: str) -> float | ChatResponse:
    """Perplexity per token of `text` after its first word, or the response that explains why it was not measured."""
    first, rest = text.split(" ", 1)
    body = {
        "prompt": first,
        "n_predict": 2 * len(rest),
        "temperature": 0.0,
        "n_probs": 1,
        # Forced tokens are wanted here, unlike in a contract's grammar: only one text can follow.
        "grammar": f"%llguidance {{}}\nstart: {json.dumps(' ' + rest.strip())}",
    }
    answer = planner.post_json("/completion", body)
    if isinstance(answer, ChatResponse):
        return answer
    steps = [step for step in answer.get("completion_probabilities", []) if step.get("token")]
    if answer.get("content") != " " + rest.strip() or not steps:
        return ChatResponse(text="", finish_reason="error", detail="the text was not written as given")
    return math.exp(-sum(float(step["logprob"]) for step in steps) / len(steps))
