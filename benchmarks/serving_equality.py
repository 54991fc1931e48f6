"""Do torch and llama.cpp say the same with one adapter? Held-out questions, greedy and free, side by side.

    python benchmarks/serving_equality.py [ADAPTER] [--count 30] [--threads 1] [--out FILE]

ADAPTER is the name of a packaged adapter or a folder that a fit made (default base-135m). The reference is torch in
float32 with the adapter as peft wears it, on the dequantised base; llama.cpp has the untouched GGUF and the converted
adapter. Equal means: the same text. Where they part, the margin between torch's best and second best token tells
whether it was a near-tie. One JSON row a question; wanted: at least 28 of 30 equal, the others at near-ties.
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
from dualbrain.cli.common.paths import cache_folder, dualbrain_home
from dualbrain.core.weights import find_weight_file
from dualbrain.planner.backends.llama_cpp import LlamaConfig
from dualbrain.planner.prompt.prompt_format import UNCONSTRAINED_SHORT_PROMPT
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples

MAX_TOKENS = 320
NEAR_TIE_NATS = 0.5
"""A parting below this margin [nats] is a near-tie."""


def main() -> int:
    """Exit code 1 if fewer are equal than wanted, or one parts where torch was sure."""
    asked = parse(sys.argv[1:])
    name = asked.adapter if "/" in asked.adapter else f"adapter:{asked.adapter}"
    stack = load_stack(resolve_folder(name, AdapterRegistry(dualbrain_home() / "adapters")), cache_folder())
    questions = generate_examples(asked.count, "test", robot_shares={stack.top_card.robot: 1.0})
    torch.set_num_threads(asked.threads)
    model, tokenizer = load_with_peft(stack)
    planner = start_llama(
        stack, cache_folder(), LlamaConfig(threads=asked.threads, n_ctx=N_CTX), prompt_format=UNCONSTRAINED_SHORT_PROMPT
    )
    rows: list[dict[str, Any]] = []
    try:
        for number, one in enumerate(questions, start=1):
            said = complete(planner, one.prompt, max_tokens=MAX_TOKENS)
            assert isinstance(said, RawCompletion), said
            rows.append(compare_answer(one.id, said, model, tokenizer, one.prompt))
            print(f"{number}/{asked.count} {json.dumps(rows[-1])}", file=sys.stderr, flush=True)
    finally:
        planner.close()
    equal, sure = sum(row["equal"] for row in rows), [r for r in rows if not r["equal"] and r["margin"] > NEAR_TIE_NATS]
    if asked.out:
        asked.out.write_text("".join(json.dumps(row) + "\n" for row in rows))
    least = statistics.median(row["least_margin"] for row in rows)
    print(
        f"{stack.top_card.id[:16]} on {stack.base}: {equal} of {len(rows)} texts equal; least margin of a text {least:.2f}"
    )
    for row in (row for row in rows if not row["equal"]):
        words = f"{row['torch']!r} | {row['llama']!r}"
        print(f"  {row['question']} parts at token {row['at']}, {row['margin']:.3f} nats apart: {words}")
    return 0 if equal >= len(rows) - 2 and not sure else 1


def load_with_peft(stack: AdapterStack) -> tuple[Any, Any]:
    """Model and tokenizer in float32: peft, and not our reader, wears the top adapter; what lies below is merged."""
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
    question: str, said: RawCompletion, model: Any, tokenizer: Any, turns: list[dict[str, str]]
) -> dict[str, Any]:
    """One row. Where the texts part, `at` counts tokens, `margin` is torch's there.

    Torch reads question and answer in one pass: greedy decoding says the same exactly if each token, and the end, is
    the most probable after those before it.
    """
    given, end = list(tokenize_prompt(tokenizer, turns)), tokenizer.eos_token_id
    spoken = [token for token in said.tokens if token != end]  # some builds count the end among the tokens
    wanted = [*spoken, end] if said.is_complete else spoken
    logits = model(input_ids=torch.tensor([given + wanted[:-1]]), use_cache=False).logits[0, len(given) - 1 :]
    best = logits.log_softmax(-1).topk(2)
    margins, first = (best.values[:, 0] - best.values[:, 1]).tolist(), best.indices[:, 0].tolist()
    at = next((place for place, (ours, theirs) in enumerate(zip(wanted, first, strict=True)) if ours != theirs), None)
    row: dict[str, Any] = {"question": question, "tokens": len(wanted), "equal": at is None}
    if at is None:
        return row | {"least_margin": min(margins)}
    words = [tokenizer.decode([*wanted[max(0, at - 6) : at], token]) for token in (first[at], wanted[at])]
    return row | {
        "least_margin": min(margins[: at + 1]),
        "at": at,
        "margin": margins[at],
        "torch": words[0],
        "llama": words[1],
    }


if __name__ == "__main__":
    sys.exit(main())
