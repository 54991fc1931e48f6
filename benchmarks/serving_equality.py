"""Equality of the answers of torch and llama.cpp with one adapter, for held-out requests with greedy decoding.

    python -m benchmarks.serving_equality [ADAPTER] [--count 30] [--threads 1] [--out FILE]

ADAPTER is the name of a packaged adapter or the folder of a trained one (default base-135m). The reference is torch in
float32 with the adapter loaded by peft on the dequantized base model; llama.cpp loads the original GGUF file and the
converted adapter. Decoding is unconstrained. Two answers are equal if their texts are equal. Where they differ, the
margin between the best and the second best token of torch shows whether it was a near-tie. Required: at most two
answers of all differ, each at a near-tie. The output is one JSON row per request.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from pathlib import Path
from typing import Any

import torch

from dualbrain.adaptation.adapters.base_models import BaseModel
from dualbrain.adaptation.adapters.naming import resolve_folder
from dualbrain.adaptation.adapters.registry import AdapterRegistry
from dualbrain.adaptation.adapters.stacking import AdapterStack, load_stack
from dualbrain.adaptation.serving.open_planner import N_CTX, start_llama
from dualbrain.adaptation.serving.raw_completion import RawCompletion, complete
from dualbrain.adaptation.training.model.base_model import load_base_model
from dualbrain.adaptation.training.model.batching import tokenize_prompt
from dualbrain.adaptation.training.model.lora_model import load_peft_adapter
from dualbrain.core.paths import cache_folder, dualbrain_home
from dualbrain.core.weights import find_weight_file
from dualbrain.planner.backends.llama_cpp import LlamaConfig
from dualbrain.planner.prompt.prompt_format import UNCONSTRAINED_SHORT_PROMPT
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples

MAX_TOKENS = 320
NEAR_TIE_NATS = 0.5
"""A difference at a margin below this is a near-tie [nats]."""


def main() -> int:
    """Return exit code 1 if more than two answers differ, or one of them not at a near-tie."""
    options = parse(sys.argv[1:])
    name = options.adapter if "/" in options.adapter else f"adapter:{options.adapter}"
    stack = load_stack(resolve_folder(name, AdapterRegistry(dualbrain_home() / "adapters")), cache_folder())
    samples = generate_examples(options.count, "test", robot_shares={stack.top_card.robot: 1.0})
    torch.set_num_threads(options.threads)
    model, tokenizer = load_with_peft(stack)
    planner = start_llama(
        stack,
        cache_folder(),
        LlamaConfig(threads=options.threads, n_ctx=N_CTX),
        prompt_format=UNCONSTRAINED_SHORT_PROMPT,
    )
    rows: list[dict[str, Any]] = []
    try:
        for number, one in enumerate(samples, start=1):
            answer = complete(planner, one.prompt, max_tokens=MAX_TOKENS)
            assert isinstance(answer, RawCompletion), answer
            rows.append(compare_answer(one.id, answer, model, tokenizer, one.prompt))
            print(f"{number}/{options.count} {json.dumps(rows[-1])}", file=sys.stderr, flush=True)
    finally:
        planner.close()
    equal = sum(row["equal"] for row in rows)
    clear = [row for row in rows if not row["equal"] and row["margin"] > NEAR_TIE_NATS]
    if options.out:
        options.out.write_text("".join(json.dumps(row) + "\n" for row in rows))
    margin = statistics.median(row["least_margin"] for row in rows)
    print(
        f"{stack.top_card.id[:16]} on {stack.base}: {equal} of {len(rows)} texts equal; "
        f"median of the smallest margins {margin:.2f} nats"
    )
    for row in (row for row in rows if not row["equal"]):
        texts = f"{row['torch']!r} | {row['llama']!r}"
        print(f"  {row['question']}: first difference at token {row['at']}, margin {row['margin']:.3f} nats: {texts}")
    return 0 if equal >= len(rows) - 2 and not clear else 1


def load_with_peft(stack: AdapterStack) -> tuple[Any, Any]:
    """Return model and tokenizer in float32, with the top adapter loaded by peft and lower adapters merged."""
    below = tuple(layer.folder for layer in stack.layers[:-1])
    base = BaseModel(
        name=stack.base, gguf=stack.gguf, gguf_sha256=find_weight_file(stack.base).sha256, stacked_on=below
    )
    model, tokenizer = load_base_model(base, cache_folder(), torch.float32)
    return load_peft_adapter(model, stack.layers[-1].folder), tokenizer


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("adapter", nargs="?", default="base-135m")
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path)
    return parser.parse_args(arguments)


@torch.no_grad()
def compare_answer(
    request_id: str, answer: RawCompletion, model: Any, tokenizer: Any, turns: list[dict[str, str]]
) -> dict[str, Any]:
    """Return the row of a request; `at` is the index of the first different token, `margin` that of torch there [nats].

    Torch evaluates request and answer in one pass: greedy decoding generates the same text if and only if each token,
    including the end token, is the most probable one after its predecessors.
    """
    prompt, end = list(tokenize_prompt(tokenizer, turns)), tokenizer.eos_token_id
    generated = [token for token in answer.tokens if token != end]  # some builds include the end token
    tokens = [*generated, end] if answer.is_complete else generated
    logits = model(input_ids=torch.tensor([prompt + tokens[:-1]]), use_cache=False).logits[0, len(prompt) - 1 :]
    top = logits.log_softmax(-1).topk(2)
    margins, first = (top.values[:, 0] - top.values[:, 1]).tolist(), top.indices[:, 0].tolist()
    at = next((k for k, (token, best) in enumerate(zip(tokens, first, strict=True)) if token != best), None)
    row: dict[str, Any] = {"question": request_id, "tokens": len(tokens), "equal": at is None}
    if at is None:
        return row | {"least_margin": min(margins)}
    texts = [tokenizer.decode([*tokens[max(0, at - 6) : at], token]) for token in (first[at], tokens[at])]
    return row | {
        "least_margin": min(margins[: at + 1]),
        "at": at,
        "margin": margins[at],
        "torch": texts[0],
        "llama": texts[1],
    }


if __name__ == "__main__":
    sys.exit(main())
