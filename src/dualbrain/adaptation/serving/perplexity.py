"""How likely the serving runtime finds a given text: the measure of what an adapter has kept (perplexity).

llama.cpp does not tell probabilities of a prompt. A grammar that admits nothing but the text makes it write the text,
and the probabilities that it tells are those before the grammar: exp(−1/n Σ_t log p(token_t | before)). Which of the
text's spellings in tokens is taken is the model's own greedy choice.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

from dualbrain.planner.backends.http_chat import ChatResponse
from dualbrain.planner.backends.llama_cpp import LlamaPlanner


def retention_text() -> str:
    """A fixed text of no robot's, in plain English, written for this."""
    return Path(__file__).with_name("perplexity_text.txt").read_text("utf-8")


def perplexity(planner: LlamaPlanner, text: str) -> float | ChatResponse:
    """Perplexity per token of `text` after its first word, or why it could not be measured."""
    first, rest = text.split(" ", 1)
    body = {
        "prompt": first,
        "n_predict": 2 * len(rest),
        "temperature": 0.0,
        "n_probs": 1,
        # forced, unlike a contract's: each token is to be the one in which the text is written
        "grammar": f"%llguidance {{}}\nstart: {json.dumps(' ' + rest.strip())}",
    }
    told = planner.post_json("/completion", body)
    if isinstance(told, ChatResponse):
        return told
    steps = [step for step in told.get("completion_probabilities", []) if step.get("token")]
    if told.get("content") != " " + rest.strip() or not steps:
        return ChatResponse(text="", finish_reason="error", detail="the text was not written as given")
    return math.exp(-sum(float(step["logprob"]) for step in steps) / len(steps))
