"""How long an adapted planner takes for a decision: in torch, with what can be foreseen given ahead, and its peers.

    python benchmarks/planner_speed.py [--count 12] [--threads 1]

Held-out questions to base-135m, bound by the same grammar: llama.cpp as it serves, torch token by token, and torch that
reads ahead; with no exemplar in the prompt, and with some. Every question goes to all three, one after the other, so
that whatever else the machine does is shared. Seconds a decision, ratio to llama.cpp (median over questions), and how
many answers were llama.cpp's to the letter.
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
from dualbrain.cli.common.paths import cache_folder, dualbrain_home
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner.protocol import Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Exemplar, RetrievedContext
from dualbrain.runtime.data_collection.rollouts import ROBOT, build_request
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples
from experiments.planning.language import exemplar_actions

BASE_ADAPTER = "base-135m"
LLAMA, TOKEN_BY_TOKEN, SPECULATIVE = "llama.cpp", "torch, token by token", "torch, reading ahead"


def main() -> int:
    """Print one table."""
    asked = parse(sys.argv[1:])
    planners = {kind: open_engine(kind, asked.threads) for kind in (LLAMA, TOKEN_BY_TOKEN, SPECULATIVE)}
    drawn = generate_examples(20 * asked.count, "test", robot_shares={ROBOT: 1.0})
    groups = {
        "no exemplar": [one for one in drawn if not exemplar_actions(one)][: asked.count],
        "one to three exemplars": [one for one in drawn if exemplar_actions(one)][: asked.count],
    }
    for planner in planners.values():
        planner.propose(plan_request(groups["no exemplar"][0]))  # loads
    print("| prompt | engine | s a decision | to llama.cpp | answers equal |\n|---|---|---|---|---|")
    try:
        for name, questions in groups.items():
            rounds = [
                [timed_answer(planner, kind, plan_request(one)) for kind, planner in planners.items()]
                for one in questions
            ]
            told = dict(zip(planners, zip(*rounds, strict=True), strict=True))
            for kind, answers in told.items():
                print(table_row(name, kind, answers, told[LLAMA]))
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
    """Seconds and text."""
    usual, speculative_decoding.MAX_READ_TOKENS = (
        speculative_decoding.MAX_READ_TOKENS,
        1 if kind == TOKEN_BY_TOKEN else speculative_decoding.MAX_READ_TOKENS,
    )
    try:
        begun = time.monotonic()
        text = planner.propose(question).text
        return time.monotonic() - begun, text
    finally:
        speculative_decoding.MAX_READ_TOKENS = usual


def table_row(name: str, kind: str, answers: Sequence[tuple[float, str]], theirs: Sequence[tuple[float, str]]) -> str:
    ratios = [own[0] / other[0] for own, other in zip(answers, theirs, strict=True)]
    equal = sum(own[1] == other[1] for own, other in zip(answers, theirs, strict=True))
    mean = statistics.mean(seconds for seconds, _ in answers)
    return f"| {name} | {kind} | {mean:.1f} | {statistics.median(ratios):.2f} | {equal} of {len(answers)} |"


def plan_request(one: Sample) -> PlanRequest:
    """The question that a lesson asks, with what it shows as if memory had recalled it."""
    recalled = tuple(
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
    return build_request(one, RetrievedContext(recalled))


if __name__ == "__main__":
    sys.exit(main())
