"""Time and correctness of plans with and without fixed examples and jump-forward decoding, in one run.

    python -m benchmarks.planner_speed.before_after PLANNER [--count 50] [--variants before after served] [--log FILE]

All variants answer the same questions, one after the other in changing order, so that other load affects all of them.
`before`: every token generated; for models without an adapter, contracts with id and context in the prompt, examples
chosen for each question, and the names in the scene listed after it. `after`: as planners serve, with saved states of
the constant part of the prompt; a name such as `transformers:base-135m` compares this adapter in torch with llama.cpp
before. `served`: as `after`, with the number of threads that `dualbrain plan` and `run` give a planner on this machine
while it is idle; the others have one thread. The first question of each process is not measured, nor is the first one
about all objects of a kind, because they read this constant part. The questions are the 60 held-out instructions of
the experiment `starter` and 40 others of the same generator, mixed, so that any prefix is a sample of both. With
`--log`, answers are appended to a JSONL file, and a later call continues.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np

from dualbrain.adaptation.adapters.naming import TORCH_PREFIX, strip_torch_prefix
from dualbrain.adaptation.adapters.packaged import packaged_names
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.serving.open_planner import N_CTX, open_adapter, open_planner
from dualbrain.cli.common.planner_threads import free_processors
from dualbrain.core.paths import cache_folder, dualbrain_home
from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.core.weights import locate_weights
from dualbrain.planner.backends.llama_cpp import LlamaConfig, LlamaPlanner
from dualbrain.planner.prompt.full_prompt import ChatMessage, render_with_examples, selected_examples
from dualbrain.planner.prompt.multi_goal import detect_needs
from dualbrain.planner.prompt.prompt_format import FULL_PROMPT, LOCAL_FULL_PROMPT
from dualbrain.planner.protocol import Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.runtime.data_collection.rollouts import ROBOT, build_request
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples
from experiments.adaptation import starter
from experiments.figures.tables import format_proportion, markdown_table
from experiments.planning.language import is_right, score_question

BEFORE, AFTER, SERVED = "before", "after", "served"
N_NEW, NEW_SEED = 40, 2026
N_UNMEASURED = 40
BOOTSTRAPS = 2000


def main() -> int:
    """Answer the questions, and print one table."""
    options = parse(sys.argv[1:])
    log = JsonlLog(Path(options.log)) if options.log else None
    rows = log.read() if log else []
    answered = {row["key"] for row in rows}
    missing = [
        (n, one) for n, one in enumerate(questions()[: options.count]) if f"{options.planner} {n}" not in answered
    ]
    with ExitStack() as stack:
        states = Path(stack.enter_context(TemporaryDirectory()))
        kinds = options.variants if missing else ()
        planners = {kind: open_variant(options.planner, kind, threads_of(kind), states / kind) for kind in kinds}
        for planner in planners.values():
            stack.callback(planner.close)
            for one in unmeasured_questions():
                planner.propose(build_request(one))
        for n, question in missing:
            answers = {kind: answer(planners[kind], question) for kind in rotated(tuple(planners), n)}
            row = {"key": f"{options.planner} {n}", "planner": options.planner, "number": n, **answers}
            rows.append(row)
            if log:
                log.append(row)
    print("\n".join(report([row for row in rows if row["planner"] == options.planner])))
    return 0


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("planner")
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--variants", nargs="+", choices=(BEFORE, AFTER, SERVED), default=[BEFORE, AFTER])
    parser.add_argument("--log", default="")
    return parser.parse_args(arguments)


def threads_of(kind: str) -> int:
    """The number of threads of a variant."""
    return free_processors(os.cpu_count() or 1, 0.0) if kind == SERVED else 1


def rotated(kinds: Sequence[str], number: int) -> list[str]:
    """The variants in the order of question `number`: each is first, second and last equally often."""
    start = number % len(kinds)
    return [*kinds[start:], *kinds[:start]]


def questions() -> list[Sample]:
    """The held-out questions with the new ones: of five consecutive questions two are new."""
    new = generate_examples(N_NEW, "test", NEW_SEED, {ROBOT: 1.0}, exemplar_share=0.0)
    held_out = starter.questions()
    groups = zip(*(iter(held_out),) * 3, *(iter(new),) * 2, strict=True)
    return [one for group in groups for one in group]


def unmeasured_questions() -> list[Sample]:
    """Two questions that are not among those that are measured: a usual one, and one about all objects of a kind."""
    found = generate_examples(N_UNMEASURED, "test", NEW_SEED + 1, {ROBOT: 1.0}, exemplar_share=0.0)
    needs = [detect_needs(build_request(one)) for one in found]
    return [found[needs.index(())], found[needs.index(("every",))]]


def open_variant(name: str, kind: str, threads: int, states: Path) -> Planner:
    """The planner called `name`, without (`before`) or with (`after`, `served`) the change under test.

    The variant before of an adapter in torch is this adapter in llama.cpp.
    """
    cache = states if kind != BEFORE else None
    config = LlamaConfig(threads=threads, n_ctx=N_CTX, jump_forward=kind != BEFORE, prompt_cache=cache)
    if name.startswith(TORCH_PREFIX):
        if kind != BEFORE:
            adapters = dualbrain_home() / "adapters"
            return open_planner(name, cache_folder(), adapters=adapters, threads=threads)
        name = strip_torch_prefix(name)
    if name in packaged_names():
        return open_adapter(name, cache_folder(), adapters=dualbrain_home() / "adapters", config=config)
    prompt_format = LOCAL_FULL_PROMPT if kind != BEFORE else replace(FULL_PROMPT, messages=render_with_selected)
    return LlamaPlanner(name, locate_weights(name, cache_folder()), config, prompt_format=prompt_format)


def render_with_selected(request: PlanRequest) -> list[ChatMessage]:
    """The full prompt with examples that are chosen for the question, and with the names in the scene once more."""
    names = [line for line in request.skills_text.splitlines() if line.startswith(("graspable:", "receptive:"))]
    with_names = msgspec.structs.replace(request, scene="\n".join((request.scene, *names)))
    return render_with_examples(with_names, selected_examples(request))


def answer(planner: Planner, question: Sample) -> dict[str, Any]:
    """The answer to a question: its text, whether it is right, and its times [s]."""
    request, start = build_request(question), time.monotonic()
    proposal = planner.propose(request)
    seconds = time.monotonic() - start
    right = bool(is_right(score_question(question, proposal.text))) if proposal.text else False
    finish = proposal.finish_reason
    return {"text": proposal.text, "finish": finish, "right": right, "s": seconds, "timings": proposal.timings}


def report(rows: Sequence[dict[str, Any]]) -> list[str]:
    """One line per variant with its median time and right answers, then its ratio to `before`."""
    if not rows:
        return ["no answers"]
    kinds = [kind for kind in (BEFORE, AFTER, SERVED) if all(kind in row for row in rows)]
    head = ("variant", "median s", "prefill", "decode", "new tokens of the prompt", "tokens of the answer", "right")
    lines = markdown_table(head, [table_row(kind, [row[kind] for row in rows]) for kind in kinds])
    return [*lines, *(ratio_line(rows, kind) for kind in kinds[1:])]


def ratio_line(rows: Sequence[dict[str, Any]], kind: str) -> str:
    """Median ratio of the times of `kind` to those before, with its bootstrap interval, and the equal answers."""
    ratios = np.array([row[kind]["s"] / row[BEFORE]["s"] for row in rows])
    draws = np.random.default_rng(0).choice(ratios, (BOOTSTRAPS, len(ratios)))
    low, high = np.percentile(np.median(draws, axis=1), (2.5, 97.5))
    total = sum(row[kind]["s"] for row in rows) / sum(row[BEFORE]["s"] for row in rows)
    equal = sum(row[kind]["text"] == row[BEFORE]["text"] for row in rows)
    return (
        f"{kind}: {len(rows)} questions; median ratio {np.median(ratios):.2f} (95 % interval {low:.2f} to {high:.2f}), "
        f"ratio of the sums {total:.2f}; {equal} equal answers"
    )


def table_row(kind: str, answers: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    def middle(value: str) -> float:
        return statistics.median(one["timings"].get(value, float("nan")) for one in answers)

    new = statistics.median(one["timings"]["prompt_tokens"] - one["timings"]["cached_tokens"] for one in answers)
    return (
        kind,
        f"{statistics.median(one['s'] for one in answers):.1f}",
        f"{middle('prefill'):.1f}",
        f"{middle('decode'):.1f}",
        f"{new:.0f}",
        f"{middle('output_tokens'):.0f}",
        format_proportion(sum(one["right"] for one in answers), len(answers)),
    )


if __name__ == "__main__":
    sys.exit(main())
