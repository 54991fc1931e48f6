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
from dualbrain.cli.common.paths import cache, home
from dualbrain.grounding.vocabulary import vocabulary
from dualbrain.planner.protocol import Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Exemplar, Recall
from dualbrain.runtime.data_collection.rollouts import ROBOT, request_of
from dualbrain.runtime.data_collection.synthetic_scenes import lessons
from experiments.planning.language import shown

NAME = "base-135m"
LLAMA, PLAIN, AHEAD = "llama.cpp", "torch, token by token", "torch, reading ahead"


def main() -> int:
    """Print one table."""
    asked = parse(sys.argv[1:])
    planners = {kind: opened(kind, asked.threads) for kind in (LLAMA, PLAIN, AHEAD)}
    drawn = lessons(20 * asked.count, "test", robots={ROBOT: 1.0})
    groups = {
        "no exemplar": [one for one in drawn if not shown(one)][: asked.count],
        "one to three exemplars": [one for one in drawn if shown(one)][: asked.count],
    }
    for planner in planners.values():
        planner.propose(request(groups["no exemplar"][0]))  # loads
    print("| prompt | engine | s a decision | to llama.cpp | answers equal |\n|---|---|---|---|---|")
    try:
        for name, questions in groups.items():
            rounds = [[answer(planner, kind, request(one)) for kind, planner in planners.items()] for one in questions]
            told = dict(zip(planners, zip(*rounds, strict=True), strict=True))
            for kind, answers in told.items():
                print(line(name, kind, answers, told[LLAMA]))
    finally:
        for planner in planners.values():
            planner.close()
    return 0


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--threads", type=int, default=1)
    return parser.parse_args(arguments)


def opened(kind: str, threads: int) -> Planner:
    name = NAME if kind == LLAMA else f"transformers:{NAME}"
    folder, registry = home() / "adapters", vocabulary(ROBOT).hash
    return open_planner(name, cache(), adapters=folder, robot=ROBOT, registry=registry, threads=threads)


def answer(planner: Planner, kind: str, question: PlanRequest) -> tuple[float, str]:
    """Seconds and text."""
    usual, speculative_decoding.AHEAD = speculative_decoding.AHEAD, 1 if kind == PLAIN else speculative_decoding.AHEAD
    try:
        begun = time.monotonic()
        text = planner.propose(question).text
        return time.monotonic() - begun, text
    finally:
        speculative_decoding.AHEAD = usual


def line(name: str, kind: str, answers: Sequence[tuple[float, str]], theirs: Sequence[tuple[float, str]]) -> str:
    ratios = [own[0] / other[0] for own, other in zip(answers, theirs, strict=True)]
    equal = sum(own[1] == other[1] for own, other in zip(answers, theirs, strict=True))
    mean = statistics.mean(seconds for seconds, _ in answers)
    return f"| {name} | {kind} | {mean:.1f} | {statistics.median(ratios):.2f} | {equal} of {len(answers)} |"


def request(one: Sample) -> PlanRequest:
    """The question that a lesson asks, with what it shows as if memory had recalled it."""
    recalled = tuple(
        Exemplar(f"m-{rank}", "", "", {"action_sequence": msgspec.to_builtins(steps)}, True, 0.0, 1.0, 0.5, 1.0, rank)
        for rank, steps in enumerate(shown(one), start=1)
    )
    return request_of(one, Recall(recalled))


if __name__ == "__main__":
    sys.exit(main())
