"""retention: what a model still knows of the rest of the world after it was taught contracts.

The same lessons are taught without the KL term (that is base-135m) and with it. Measured in the runtime that serves:
perplexity of a fixed text of no robot's, and plain questions whose answers must hold a word.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.adaptation.bases import find_base
from dualbrain.adaptation.config import ObjectiveDials
from dualbrain.adaptation.lessons.course import CHECKS, DIALS, LESSONS, course, language_judge
from dualbrain.adaptation.serving.layers import Stack, stack_of
from dualbrain.adaptation.serving.likelihood import perplexity, retention_text
from dualbrain.adaptation.serving.opening import N_CTX, wear
from dualbrain.adaptation.serving.packaged import packaged_folder
from dualbrain.adaptation.serving.speaking import Said, say
from dualbrain.cli import folders
from dualbrain.planner.asking import FREE
from dualbrain.planner.llama import LlamaConfig
from dualbrain.runtime.classroom import ROBOTS, lessons
from dualbrain.runtime.vocabulary import vocabulary
from dualbrain.weights import find_file, locate
from proofs.figures import share, table
from proofs.proof import Options, Row, Unit

BASE = "smollm2-135m-instruct"
BETA = ObjectiveDials().beta
ARMS = {"before": None, "after, β = 0": 0.0, f"after, β = {BETA:g}": BETA}
LONGEST = 40
QUESTIONS = (
    ("What is the capital of France?", "paris"), ("What is the capital of Italy?", "rome"),
    ("What is the opposite of hot?", "cold"), ("What is the opposite of left?", "right"),
    ("How many days does a week have?", "seven|7"), ("How many legs does a spider have?", "eight|8"),
    ("Which animal says meow?", "cat"), ("What do bees make?", "honey"), ("What is two plus three?", "five|5"),
    ("What is ten minus four?", "six|6"), ("Which colour does the sky have on a clear day?", "blue"),
    ("What is frozen water called?", "ice"), ("On which planet do we live?", "earth"),
    ("What is the first month of the year?", "january"), ("Name a fruit that is yellow.", "banana|lemon"),
    ("What do you call the child of a cow?", "calf"), ("Which season comes after winter?", "spring"),
    ("What do you use to cut paper?", "scissor"), ("In which country is Tokyo?", "japan"),
    ("What is H2O commonly called?", "water"),
)  # fmt: skip
"""A question and the words one of which a right answer holds."""


class Retention:
    """Teaching contracts costs little else."""

    name = "retention"
    claim = (
        "Perplexity of a text of no robot's and 20 plain questions, before and after the lessons, with and without KL."
    )

    def units(self, options: Options) -> list[Unit]:
        """Before, and after each way of teaching."""
        return [Unit(arm, {"arm": arm, "folder": str(options.folder / self.name)}) for arm in ARMS]

    def run(self, about: dict[str, Any]) -> Row:
        """Teach if need be, then ask."""
        stack = taught(ARMS[about["arm"]], Path(about["folder"]))
        planner = wear(stack, folders.cache(), LlamaConfig(threads=1, n_ctx=N_CTX), asking=FREE)
        try:
            measured = perplexity(planner, retention_text())
            turns = [[{"role": "user", "content": question}] for question, _ in QUESTIONS]
            said = [say(planner, one, longest=LONGEST) for one in turns]
        finally:
            planner.close()
        texts = [one.text if isinstance(one, Said) else "" for one in said]
        found = measured if isinstance(measured, float) else math.nan
        return {"arm": about["arm"], "perplexity": found, "texts": texts,
                "right": list(map(known, texts, (words for _, words in QUESTIONS)))}  # fmt: skip

    def brief(self, row: Row) -> str:
        """Both figures."""
        return f"perplexity {row['perplexity']:.2f}, {sum(row['right'])} of {len(row['right'])} known"

    def report(self, rows: list[Row]) -> list[str]:
        """One line a way of teaching."""
        cells = ((r["arm"], f"{r['perplexity']:.2f}", share(sum(r["right"]), len(r["right"]))) for r in rows)
        return table(("", "perplexity", "questions known"), cells)


def known(text: str, words: str) -> bool:
    """Whether `text` holds one of `words`."""
    return any(word in text.lower() for word in words.split("|"))


def taught(beta: float | None, folder: Path) -> Stack:
    """The bare model, base-135m, or the model taught the same lessons with the KL term; that is fitted here."""
    if beta is None:
        return Stack(find_file(BASE).name, locate(BASE, folders.cache()), ())
    if beta == 0.0:
        return stack_of(packaged_folder("base-135m"), folders.cache())
    from dualbrain.adaptation.fitting.night import adapt  # noqa: PLC0415  (torch, only where something is fitted)

    registries = {robot: vocabulary(robot) for robot in ROBOTS}
    dials = msgspec.structs.replace(DIALS, objective=msgspec.structs.replace(DIALS.objective, beta=beta))
    data = course(lessons(LESSONS, "teach"), lessons(CHECKS, "check"), registries)
    adapt(
        data, dials, find_base(BASE, folders.cache()), language_judge(registries), folder, cache=folders.cache(),
        clock=time.monotonic, tell=lambda progress: None,
    )  # fmt: skip
    return stack_of(folder / "adapter", folders.cache())
