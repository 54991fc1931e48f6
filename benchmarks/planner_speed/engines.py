"""Time of a plan of an adapted planner: llama.cpp, torch token by token, and torch with speculative decoding.

    python -m benchmarks.planner_speed.engines [--count 12] [--threads 1]

All three engines answer the same held-out requests with base-135m and the same grammar, without and with exemplars in
the prompt. They alternate on each request, so that other load affects all of them. The table holds seconds per plan,
the median ratio to llama.cpp, and the number of answers with the same text as that of llama.cpp.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Sequence

import msgspec

from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.serving import speculative_decoding
from dualbrain.adaptation.serving.open_planner import open_planner
from dualbrain.core.paths import cache_folder, dualbrain_home
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner.protocol import Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Exemplar, RetrievedContext
from dualbrain.runtime.data_collection.rollouts import ROBOT, build_request
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples
from experiments.planning.language import exemplar_actions

BASE_ADAPTER = "base-135m"
LLAMA, TOKEN_BY_TOKEN, SPECULATIVE = "llama.cpp", "torch, token by token", "torch, speculative decoding"


def main() -> int:
    """Print one table."""
    options = parse(sys.argv[1:])
    planners = {kind: open_engine(kind, options.threads) for kind in (LLAMA, TOKEN_BY_TOKEN, SPECULATIVE)}
    samples = generate_examples(20 * options.count, "test", robot_shares={ROBOT: 1.0})
    groups = {
        "no exemplar": [one for one in samples if not exemplar_actions(one)][: options.count],
        "one to three exemplars": [one for one in samples if exemplar_actions(one)][: options.count],
    }
    for planner in planners.values():
        planner.propose(plan_request(groups["no exemplar"][0]))  # loads the model
    print("| prompt | engine | s per plan | ratio to llama.cpp | equal answers |\n|---|---|---|---|---|")
    try:
        for name, questions in groups.items():
            rounds = [
                [timed_answer(planner, kind, plan_request(one)) for kind, planner in planners.items()]
                for one in questions
            ]
            by_engine = dict(zip(planners, zip(*rounds, strict=True), strict=True))
            for kind, answers in by_engine.items():
                print(table_row(name, kind, answers, by_engine[LLAMA]))
    finally:
        for planner in planners.values():
            planner.close()
    return 0


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--threads", type=int, default=1)
    return parser.parse_args(arguments)


def open_engine(kind: str, threads: int) -> Planner:
    name = BASE_ADAPTER if kind == LLAMA else f"transformers:{BASE_ADAPTER}"
    folder, registry = dualbrain_home() / "adapters", load_skill_registry(ROBOT).hash
    return open_planner(name, cache_folder(), adapters=folder, robot=ROBOT, registry=registry, threads=threads)


def timed_answer(planner: Planner, kind: str, question: PlanRequest) -> tuple[float, str]:
    """Return the time of an answer [s] and its text."""
    default, speculative_decoding.MAX_READ_TOKENS = (
        speculative_decoding.MAX_READ_TOKENS,
        1 if kind == TOKEN_BY_TOKEN else speculative_decoding.MAX_READ_TOKENS,
    )
    try:
        start = time.monotonic()
        text = planner.propose(question).text
        return time.monotonic() - start, text
    finally:
        speculative_decoding.MAX_READ_TOKENS = default


def table_row(
    name: str, kind: str, answers: Sequence[tuple[float, str]], reference: Sequence[tuple[float, str]]
) -> str:
    ratios = [own[0] / other[0] for own, other in zip(answers, reference, strict=True)]
    equal = sum(own[1] == other[1] for own, other in zip(answers, reference, strict=True))
    mean = statistics.mean(seconds for seconds, _ in answers)
    return f"| {name} | {kind} | {mean:.1f} | {statistics.median(ratios):.2f} | {equal} of {len(answers)} |"


def plan_request(one: Sample) -> PlanRequest:
    """Return the request of a sample, with its exemplars as retrieved context."""
    exemplars = tuple(
        Exemplar(
            episode_id=f"m-{rank}",
            instruction="",
            summary="",
            contract={"action_sequence": msgspec.to_builtins(steps)},
            succeeded=True,
            Delta=0.0,
            similarity=1.0,
            weight=0.5,
            score=1.0,
            rank=rank,
        )
        for rank, steps in enumerate(exemplar_actions(one), start=1)
    )
    return build_request(one, RetrievedContext(exemplars))


if __name__ == "__main__":
    sys.exit(main())
