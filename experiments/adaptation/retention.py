"""retention: what a model still knows of the rest of the world after lessons, and after a night of adaptation.

The nights are those of `adapt_curve`, without the KL term, with it, and with the whole objective, and of `nights` the
one of suite `paper` beside that of its ablation without the KL term. Measured in the runtime that serves: perplexity of
a fixed text of no robot's, and plain questions whose answers must hold a word.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from dualbrain.adaptation.adapters.card import CARD_FILE
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.adaptation.adapters.stacking import AdapterStack, load_stack
from dualbrain.adaptation.serving.open_planner import N_CTX, start_llama
from dualbrain.adaptation.serving.perplexity import perplexity, retention_text
from dualbrain.adaptation.serving.raw_completion import RawCompletion, complete
from dualbrain.cli.common import paths
from dualbrain.core.weights import find_weight_file, locate_weights
from dualbrain.planner.backends.http_chat import ChatResponse
from dualbrain.planner.backends.llama_cpp import LlamaConfig
from dualbrain.planner.prompt.prompt_format import UNCONSTRAINED_SHORT_PROMPT
from experiments.adaptation import ablation_curve
from experiments.adaptation.no_answer import NoAnswerError
from experiments.adaptation.rounds import Rounds
from experiments.adaptation.suite_adapters import FULL_ADAPTER, adapter_folder
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table

BARE_MODEL, BASE_ADAPTER = "smollm2-135m-instruct", "base-135m"
CURVE_ARMS = ("sft, clean ones", "+ KL", "full")
"""Arms of `adapt_curve`: β = 0, the default β, the whole objective with it."""
ROUND_ADAPTERS = (FULL_ADAPTER, "adapted_no_kl")
"""Adapters of `nights`, of one chain."""
MAX_TOKENS = 40
QUESTIONS = (
    ("What is the capital of France?", "paris"),
    ("What is the capital of Italy?", "rome"),
    ("What is the opposite of hot?", "cold"),
    ("What is the opposite of left?", "right"),
    ("How many days does a week have?", "seven|7"),
    ("How many legs does a spider have?", "eight|8"),
    ("Which animal says meow?", "cat"),
    ("What do bees make?", "honey"),
    ("What is two plus three?", "five|5"),
    ("What is ten minus four?", "six|6"),
    ("Which colour does the sky have on a clear day?", "blue"),
    ("What is frozen water called?", "ice"),
    ("On which planet do we live?", "earth"),
    ("What is the first month of the year?", "january"),
    ("Name a fruit that is yellow.", "banana|lemon"),
    ("What do you call the child of a cow?", "calf"),
    ("Which season comes after winter?", "spring"),
    ("What do you use to cut paper?", "scissor"),
    ("In which country is Tokyo?", "japan"),
    ("What is H2O commonly called?", "water"),
)
"""A question and the words one of which a right answer holds."""


class Retention:
    """Teaching contracts costs little else."""

    name = "retention"
    claim = (
        "Perplexity of a text of no robot's and 20 plain questions: of the bare model, after the lessons of the base, "
        f"and after nights from there, without KL (β = 0), with it (β = {ablation_curve.FULL_OBJECTIVE.beta:g}), and with all."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Bare and base, the nights that rounds led to, then those of `adapt_curve` seed by seed."""
        nights = [(arm, seed) for seed in ablation_curve.SEEDS for arm in CURVE_ARMS]
        told = [(arm, 0) for arm in (BARE_MODEL, BASE_ADAPTER, *ROUND_ADAPTERS)] + nights
        folder = str(options.folder)
        return [WorkUnit(f"{arm}, seed {seed}", {"arm": arm, "seed": seed, "folder": folder}) for arm, seed in told]

    def run(self, about: dict[str, Any]) -> Row:
        """Fit if `adapt_curve` has not yet, then ask."""
        stack = adapter_stack(about["arm"], about["seed"], Path(about["folder"]))
        planner = start_llama(
            stack, paths.cache_folder(), LlamaConfig(threads=1, n_ctx=N_CTX), prompt_format=UNCONSTRAINED_SHORT_PROMPT
        )
        try:
            measured = perplexity(planner, retention_text())
            turns = [[{"role": "user", "content": question}] for question, _ in QUESTIONS]
            said = [complete(planner, one, max_tokens=MAX_TOKENS) for one in turns]
        finally:
            planner.close()
        texts = [answer_text(one) for one in said]
        if isinstance(measured, ChatResponse):
            raise NoAnswerError(measured.finish_reason, measured.detail)
        return {
            "arm": about["arm"],
            "seed": about["seed"],
            "perplexity": measured,
            "texts": texts,
            "right": list(map(is_known, texts, (words for _, words in QUESTIONS))),
        }

    def summarize_row(self, row: Row) -> str:
        """Both figures."""
        return f"perplexity {row['perplexity']:.2f}, {sum(row['right'])} of {len(row['right'])} known"

    def report(self, rows: list[Row]) -> list[str]:
        """One line an arm: perplexity of each seed, questions of all."""
        by_arm = {
            arm: [row for row in rows if row["arm"] == arm]
            for arm in (BARE_MODEL, BASE_ADAPTER, *ROUND_ADAPTERS, *CURVE_ARMS)
        }
        cells = (
            (
                arm,
                ", ".join(f"{row['perplexity']:.2f}" for row in mine),
                format_proportion(sum(sum(row["right"]) for row in mine), sum(len(row["right"]) for row in mine)),
            )
            for arm, mine in by_arm.items()
            if mine
        )
        return markdown_table(("", "perplexity, by seed", "questions known"), cells)


def answer_text(said: RawCompletion | ChatResponse) -> str:
    """The words of an answer; raises `NoAnswer`."""
    if isinstance(said, ChatResponse):
        raise NoAnswerError(said.finish_reason, said.detail)
    return said.text


def is_known(text: str, words: str) -> bool:
    """Whether `text` is no contract and has one of `words` in it."""
    return "{" not in text and re.search(rf"\b(?:{words})s?\b", text.lower()) is not None


def adapter_stack(arm: str, seed: int, folder: Path) -> AdapterStack:
    """The bare model, the base, or the base after a night; what is not fitted yet in `folder` is."""
    if arm == BARE_MODEL:
        return AdapterStack(find_weight_file(BARE_MODEL).name, locate_weights(BARE_MODEL, paths.cache_folder()), ())
    return load_stack(_adapter_folder(arm, seed, folder), paths.cache_folder())


def _adapter_folder(arm: str, seed: int, folder: Path) -> Path:
    """The folder of an adapter; one that a proof has left is taken as it is, for that is what the proof measured."""
    if arm == BASE_ADAPTER:
        return packaged_folder(BASE_ADAPTER)
    if arm in ROUND_ADAPTERS:
        return adapter_folder(arm, folder / Rounds.name)
    curve = folder / ablation_curve.AblationCurve.name
    left = ablation_curve.training_folder(arm, seed, ablation_curve.N_STEPS, curve) / "adapter"
    if not left.joinpath(CARD_FILE).is_file():
        ablation_curve.train_arm(arm, seed, ablation_curve.N_STEPS, curve)
    return left
