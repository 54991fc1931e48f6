"""Retention of general knowledge after training on synthetic examples and after adaptation.

The adapters are those of `ablation_curve` without the KL term, with it, and with the complete objective, and of
`suite_adapters` the one of suite `paper` and its ablation without the KL term. Measured by the serving runtime: the
perplexity of a fixed text that is not about robots, and general questions whose answers must contain a word.
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
from dualbrain.core import paths
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
"""Arms of `ablation_curve`: β = 0, the default β, and the complete objective with it."""
ROUND_ADAPTERS = (FULL_ADAPTER, "adapted_no_kl")
"""Adapters of `suite_adapters`, from one chain of rounds."""
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
"""Questions, each with words one of which a correct answer contains."""


class Retention:
    """Training on contracts costs little general knowledge."""

    name = "retention"
    claim = (
        "Perplexity of a text that is not about robots, and 20 general questions: for the bare model, after training "
        "of the base adapter, and after adaptation from there without KL term (β = 0), with it "
        f"(β = {ablation_curve.FULL_OBJECTIVE.beta:g}), and with the complete objective."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Bare model and base adapter, the adapters of rounds, then those of `ablation_curve` seed by seed."""
        curve = [(arm, seed) for seed in ablation_curve.SEEDS for arm in CURVE_ARMS]
        arms = [(arm, 0) for arm in (BARE_MODEL, BASE_ADAPTER, *ROUND_ADAPTERS)] + curve
        folder = str(options.folder)
        return [WorkUnit(f"{arm}, seed {seed}", {"arm": arm, "seed": seed, "folder": folder}) for arm, seed in arms]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Train the adapter if `ablation_curve` has not, then measure."""
        stack = adapter_stack(parameters["arm"], parameters["seed"], Path(parameters["folder"]))
        planner = start_llama(
            stack, paths.cache_folder(), LlamaConfig(threads=1, n_ctx=N_CTX), prompt_format=UNCONSTRAINED_SHORT_PROMPT
        )
        try:
            measured = perplexity(planner, retention_text())
            turns = [[{"role": "user", "content": question}] for question, _ in QUESTIONS]
            completions = [complete(planner, one, max_tokens=MAX_TOKENS) for one in turns]
        finally:
            planner.close()
        texts = [answer_text(one) for one in completions]
        if isinstance(measured, ChatResponse):
            raise NoAnswerError(measured.finish_reason, measured.detail)
        return {
            "arm": parameters["arm"],
            "seed": parameters["seed"],
            "perplexity": measured,
            "texts": texts,
            "right": list(map(is_known, texts, (words for _, words in QUESTIONS))),
        }

    def summarize_row(self, row: Row) -> str:
        """Perplexity and number of correct answers."""
        return f"perplexity {row['perplexity']:.2f}, {sum(row['right'])} of {len(row['right'])} correct"

    def report(self, rows: list[Row]) -> list[str]:
        """One line per arm: the perplexity of each seed, the correct answers of all seeds."""
        by_arm = {
            arm: [row for row in rows if row["arm"] == arm]
            for arm in (BARE_MODEL, BASE_ADAPTER, *ROUND_ADAPTERS, *CURVE_ARMS)
        }
        cells = (
            (
                arm,
                ", ".join(f"{row['perplexity']:.2f}" for row in some),
                format_proportion(sum(sum(row["right"]) for row in some), sum(len(row["right"]) for row in some)),
            )
            for arm, some in by_arm.items()
            if some
        )
        return markdown_table(("", "perplexity, by seed", "correct answers"), cells)


def answer_text(completion: RawCompletion | ChatResponse) -> str:
    """The text of an answer; raises `NoAnswerError`."""
    if isinstance(completion, ChatResponse):
        raise NoAnswerError(completion.finish_reason, completion.detail)
    return completion.text


def is_known(text: str, words: str) -> bool:
    """Whether `text` is no contract and contains one of `words`."""
    return "{" not in text and re.search(rf"\b(?:{words})s?\b", text.lower()) is not None


def adapter_stack(arm: str, seed: int, folder: Path) -> AdapterStack:
    """The bare model, the base adapter, or an adapter trained from it, which is trained here if it is missing."""
    if arm == BARE_MODEL:
        return AdapterStack(find_weight_file(BARE_MODEL).name, locate_weights(BARE_MODEL, paths.cache_folder()), ())
    return load_stack(_adapter_folder(arm, seed, folder), paths.cache_folder())


def _adapter_folder(arm: str, seed: int, folder: Path) -> Path:
    """The folder of an adapter; one that another experiment left is used as it is, because that one was measured."""
    if arm == BASE_ADAPTER:
        return packaged_folder(BASE_ADAPTER)
    if arm in ROUND_ADAPTERS:
        return adapter_folder(arm, folder / Rounds.name)
    curve = folder / ablation_curve.AblationCurve.name
    adapter = ablation_curve.training_folder(arm, seed, ablation_curve.N_STEPS, curve) / "adapter"
    if not adapter.joinpath(CARD_FILE).is_file():
        ablation_curve.train_arm(arm, seed, ablation_curve.N_STEPS, curve)
    return adapter
