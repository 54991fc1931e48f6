"""retention: what a model still knows of the rest of the world after lessons, and after a night of adaptation.

The nights are those of `adapt_curve`, without the KL term, with it, and with the whole objective, and of `nights` the
one of suite `paper` beside that of its ablation without the KL term. Measured in the runtime that serves: perplexity of
a fixed text of no robot's, and plain questions whose answers must hold a word.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from dualbrain.adaptation.adapters.card import CARD
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.adaptation.adapters.stacking import Stack, stack_of
from dualbrain.adaptation.serving.open_planner import N_CTX, wear
from dualbrain.adaptation.serving.perplexity import perplexity, retention_text
from dualbrain.adaptation.serving.raw_completion import Said, say
from dualbrain.cli.common import paths
from dualbrain.core.weights import find_file, locate
from dualbrain.planner.backends.http_chat import Answer
from dualbrain.planner.backends.llama_cpp import LlamaConfig
from dualbrain.planner.prompt.prompt_format import FREE
from experiments.adaptation import ablation_curve
from experiments.adaptation.no_answer import NoAnswer
from experiments.adaptation.rounds import Rounds
from experiments.adaptation.suite_adapters import WHOLE, fitted
from experiments.engine.experiment import Options, Row, Unit
from experiments.figures.tables import share, table

BARE, BASE = "smollm2-135m-instruct", "base-135m"
NIGHTS = ("sft, clean ones", "+ KL", "full")
"""Arms of `adapt_curve`: β = 0, the default β, the whole objective with it."""
LIVED = (WHOLE, "adapted_no_kl")
"""Adapters of `nights`, of one chain."""
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
        "Perplexity of a text of no robot's and 20 plain questions: of the bare model, after the lessons of the base, "
        f"and after nights from there, without KL (β = 0), with it (β = {ablation_curve.FULL.beta:g}), and with all."
    )

    def units(self, options: Options) -> list[Unit]:
        """Bare and base, the nights that rounds led to, then those of `adapt_curve` seed by seed."""
        nights = [(arm, seed) for seed in ablation_curve.SEEDS for arm in NIGHTS]
        told = [(arm, 0) for arm in (BARE, BASE, *LIVED)] + nights
        folder = str(options.folder)
        return [Unit(f"{arm}, seed {seed}", {"arm": arm, "seed": seed, "folder": folder}) for arm, seed in told]

    def run(self, about: dict[str, Any]) -> Row:
        """Fit if `adapt_curve` has not yet, then ask."""
        stack = taught(about["arm"], about["seed"], Path(about["folder"]))
        planner = wear(stack, paths.cache(), LlamaConfig(threads=1, n_ctx=N_CTX), asking=FREE)
        try:
            measured = perplexity(planner, retention_text())
            turns = [[{"role": "user", "content": question}] for question, _ in QUESTIONS]
            said = [say(planner, one, longest=LONGEST) for one in turns]
        finally:
            planner.close()
        texts = [text_of(one) for one in said]
        if isinstance(measured, Answer):
            raise NoAnswer(measured.finish, measured.detail)
        return {"arm": about["arm"], "seed": about["seed"], "perplexity": measured, "texts": texts,
                "right": list(map(known, texts, (words for _, words in QUESTIONS)))}  # fmt: skip

    def brief(self, row: Row) -> str:
        """Both figures."""
        return f"perplexity {row['perplexity']:.2f}, {sum(row['right'])} of {len(row['right'])} known"

    def report(self, rows: list[Row]) -> list[str]:
        """One line an arm: perplexity of each seed, questions of all."""
        by_arm = {arm: [row for row in rows if row["arm"] == arm] for arm in (BARE, BASE, *LIVED, *NIGHTS)}
        cells = (
            (arm, ", ".join(f"{row['perplexity']:.2f}" for row in mine),
             share(sum(sum(row["right"]) for row in mine), sum(len(row["right"]) for row in mine)))
            for arm, mine in by_arm.items() if mine
        )  # fmt: skip
        return table(("", "perplexity, by seed", "questions known"), cells)


def text_of(said: Said | Answer) -> str:
    """The words of an answer; raises `NoAnswer`."""
    if isinstance(said, Answer):
        raise NoAnswer(said.finish, said.detail)
    return said.text


def known(text: str, words: str) -> bool:
    """Whether `text` is no contract and has one of `words` in it."""
    return "{" not in text and re.search(rf"\b(?:{words})s?\b", text.lower()) is not None


def taught(arm: str, seed: int, folder: Path) -> Stack:
    """The bare model, the base, or the base after a night; what is not fitted yet in `folder` is."""
    if arm == BARE:
        return Stack(find_file(BARE).name, locate(BARE, paths.cache()), ())
    return stack_of(_fitted(arm, seed, folder), paths.cache())


def _fitted(arm: str, seed: int, folder: Path) -> Path:
    """The folder of an adapter; one that a proof has left is taken as it is, for that is what the proof measured."""
    if arm == BASE:
        return packaged_folder(BASE)
    if arm in LIVED:
        return fitted(arm, folder / Rounds.name)
    curve = folder / ablation_curve.AdaptCurve.name
    left = ablation_curve.place(arm, seed, ablation_curve.STEPS, curve) / "adapter"
    if not left.joinpath(CARD).is_file():
        ablation_curve.fit(arm, seed, ablation_curve.STEPS, curve)
    return left
