"""adapt_curve: what each part of adaptation is worth, from the same proposals, by free answers that nobody taught.

Every arm starts from base-135m. All arms of a seed share the flights of `proposals`; they differ in what of them is
taught and how. The answers are asked for greedily with no grammar; those that the gate accepts are carried out in their
scenes.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from dualbrain.adaptation.adapters.base_models import find_base_model
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.adaptation.adapters.stacking import AdapterStack, load_stack
from dualbrain.adaptation.compliance import make_gate_judge
from dualbrain.adaptation.config import AdaptConfig, FitConfig, ObjectiveConfig
from dualbrain.adaptation.curation.curate import curate
from dualbrain.adaptation.curation.dataset import Dataset, assemble_dataset
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.curation.selection import CleanRules
from dualbrain.adaptation.synthetic.split import HELD_OUT_CATEGORIES, HELD_OUT_FAMILY
from dualbrain.cli.common import paths
from dualbrain.evaluation.planners.few_shot import with_example
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.planner.prompt.full_prompt import ChatMessage, render
from dualbrain.planner.prompt.prompt_format import short_messages
from dualbrain.runtime.data_collection.rollouts import (
    EPSILON,
    LEDGER_FILE,
    ROBOT,
    build_request,
    draw_proposals,
    is_declined,
    load_proposals,
    memory_id_of_turn,
    run_proposals,
)
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from experiments.adaptation.free_answers import FreeAnswerModel, Sampling
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.planning.language import is_right, score_answer
from experiments.safety.closed_loop import run_contract

SEEDS, N_EXECUTED, N_PROPOSALS = range(3), 240, 280
"""Of the lessons of a seed so many are deeds that are flown; what is declined comes from the first so many."""
N_STEPS, N_STEPS_HALF, BATCH_SIZE = 60, 30, 4
"""Of a fit, and of a shorter one beside it, whose rate falls as far; samples of a step."""
QUESTIONS_PER_SLICE, EXECUTED_PER_SLICE, N_SAMPLED_ANSWERS = 20, 6, 16
"""Questions of each slice, answers of each that are carried out, draws at temperature 1 of all, each of another."""
PLAIN_OBJECTIVE = ObjectiveConfig(lambda_w=0.0, lambda_h=0.0, beta=0.0, entropy_gate="none")
FULL_OBJECTIVE = ObjectiveConfig()
TRAINED_ARMS: dict[str, tuple[bool, ObjectiveConfig]] = {
    "full": (True, FULL_OBJECTIVE),
    "sft, all proposals": (False, PLAIN_OBJECTIVE),
    "sft, clean ones": (True, PLAIN_OBJECTIVE),
    "+ entropy": (
        True,
        msgspec.structs.replace(PLAIN_OBJECTIVE, lambda_h=FULL_OBJECTIVE.lambda_h, entropy_gate="sample"),
    ),
    "+ KL": (True, msgspec.structs.replace(PLAIN_OBJECTIVE, beta=FULL_OBJECTIVE.beta)),
    "EAFT's gate": (True, msgspec.structs.replace(PLAIN_OBJECTIVE, entropy_gate="token")),
}
"""By arm: whether only clean episodes are taught, and the objective. Nothing was recalled in the flights, so that all
memories have the weight of a new one, and λ_w tells no samples apart; no arm leaves it out."""
PromptStyle = Literal["short", "example", "long"]
UNTRAINED_ARMS: dict[str, PromptStyle] = {
    "base": "short",
    "base, worked example": "example",
    "base, long prompt": "long",
}
"""Arms without a fit, by their prompt: as it was taught; with a worked example in it; rules, skills and examples."""
ALSO_AT_HALF_STEPS, SINGLE_SEED_ARMS = ("full",), ("EAFT's gate",)
"""Arms that are also fitted for half of the steps, and those of one seed only."""
METRICS = ("compliant", "skills", "right", "quiet", "valid draws")


class AblationCurve:
    """What adaptation is worth, part by part."""

    name = "ablation_curve"
    claim = (
        f"From {N_EXECUTED} random valid proposals, each carried out once: free one-shot compliance, right skills, right "
        f"things, and parameters that the filter leaves alone, by arm, after {N_STEPS_HALF} and {N_STEPS} steps of {BATCH_SIZE}. "
        "All memories have one weight: of the objective's three parts the memory weight is at rest, in every arm."
    )
    intervals = f"Student's t over {len(SEEDS)} seeds, 95 %, none for an arm of one seed"

    def units(self, options: Options) -> list[WorkUnit]:
        """The arms that need no fit, then seed by seed the whole fits, then the shorter ones."""
        fits = [
            (seed, arm, N_STEPS) for seed in SEEDS for arm in TRAINED_ARMS if seed == 0 or arm not in SINGLE_SEED_ARMS
        ]
        fits += [(seed, arm, N_STEPS_HALF) for seed in SEEDS for arm in ALSO_AT_HALF_STEPS]
        folder = str(options.folder / self.name)
        return [
            WorkUnit(f"{arm}, seed {seed}, {steps} steps", {"arm": arm, "seed": seed, "steps": steps, "folder": folder})
            for seed, arm, steps in [*((0, arm, 0) for arm in UNTRAINED_ARMS), *fits]
        ]

    def run(self, about: dict[str, Any]) -> Row:
        """Fit if the arm is taught, ask, draw, carry out."""
        arm, seed, steps, folder = about["arm"], about["seed"], about["steps"], Path(about["folder"])
        row: Row = {"arm": arm, "seed": seed, "steps": steps}
        stack = load_stack(packaged_folder("base-135m"), paths.cache_folder())
        if steps:
            row |= train_arm(arm, seed, steps, folder)
            stack = load_stack(training_folder(arm, seed, steps, folder) / "adapter", paths.cache_folder())
        return row | evaluate_arm(stack, UNTRAINED_ARMS.get(arm, "short"))

    def summarize_row(self, row: Row) -> str:
        """The measures."""
        return ", ".join(f"{what} {value:.0%}" for what, value in arm_metrics(row).items())

    def report(self, rows: list[Row]) -> list[str]:
        """Every arm at every length: means over seeds and their 95 % intervals (Student, over seeds)."""
        keys = sorted({(row["steps"], row["arm"]) for row in rows})
        cells: list[tuple[object, ...]] = []
        for steps, arm in keys:
            mine = [arm_metrics(row) for row in rows if (row["steps"], row["arm"]) == (steps, arm)]
            cells.append(
                (arm, steps, len(mine), *(format_mean_interval([one[what] for one in mine]) for what in METRICS))
            )
        lines = markdown_table(("arm", "steps", "seeds", *METRICS), cells)
        lines += ["Right, by what had not been taught and by what is asked:", ""]
        parts: list[tuple[object, ...]] = []
        for steps, arm in keys:
            mine = [row for row in rows if (row["steps"], row["arm"]) == (steps, arm)]
            told = (
                format_mean_interval([_right_share(row, belongs) for row in mine])
                for belongs in QUESTION_PARTS.values()
            )
            parts.append((arm, steps, *told, *training_cost(mine)))
        lines += markdown_table(("arm", "steps", *QUESTION_PARTS, "samples", "processor s of a fit"), parts)
        return [*lines, *NOTES, ""]


# --- teaching ---------------------------------------------------------------------------------------------------------


def training_folder(arm: str, seed: int, steps: int, folder: Path) -> Path:
    """Where a fit lies."""
    return folder / f"{arm.replace(' ', '-').replace(',', '')}-seed-{seed}-{steps}"


def train_arm(arm: str, seed: int, steps: int, folder: Path) -> Row:
    """Fit the arm, or go on where its fit was; what it was taught and what that cost."""
    from dualbrain.adaptation.training.train import adapt  # noqa: PLC0415  (torch, only where something is fitted)

    clean, objective = TRAINED_ARMS[arm]
    config = AdaptConfig(
        objective=objective,
        fit=FitConfig(
            steps=steps,
            batch=BATCH_SIZE,
            at_once=BATCH_SIZE,
            seed=seed,
            save_every=25,
            ask_at_most=0,
            threads=1,
            keep="last",
        ),
    )
    data = training_data(collect_rollouts(folder, seed), clean=clean)
    began, busy = time.monotonic(), time.process_time()
    card = adapt(
        data,
        config,
        find_base_model("base-135m", paths.cache_folder()),
        make_gate_judge(load_skill_registry(ROBOT)),
        training_folder(arm, seed, steps, folder),
        cache=paths.cache_folder(),
        clock=time.monotonic,
        report=lambda progress: None,
    )
    cost = {"fit_s": time.monotonic() - began, "fit_cpu_s": time.process_time() - busy}
    return {"adapter": card.id, "samples": len(data.train), "dataset": data.card.hash, **cost}


def collect_rollouts(folder: Path, seed: int) -> Path:
    """The flights that all arms of a seed learn from, and what was rightly declined between them."""
    kept, wanted = folder / "proposals" / f"seed {seed}, {N_EXECUTED} flights", draw_proposals(seed, N_EXECUTED)
    deeds = run_proposals(kept, N_EXECUTED, wanted.__getitem__, cache=paths.cache_folder())
    refused = [one for one in draw_proposals(seed, N_PROPOSALS, include_declines=True) if is_declined(one)]
    whole = kept.with_name(f"{kept.name}, {len(refused)} declines")

    def propose(turn: int) -> Sample:
        return refused[turn - N_EXECUTED]

    return run_proposals(
        whole, len(refused), propose, cache=paths.cache_folder(), first_turn=N_EXECUTED, initial_folder=deeds
    )


def training_data(folder: Path, *, clean: bool) -> Dataset:
    """What is taught of the flights in `folder`: the clean ones, or all that was proposed, whatever became of it."""
    registry, dials = load_skill_registry(ROBOT), AdaptConfig().curation
    dials = msgspec.structs.replace(dials, rules=CleanRules(epsilon=EPSILON, physical=clean))
    declines = [memory_id_of_turn(turn) for turn, one in enumerate(load_proposals(folder)) if is_declined(one)]
    with LedgerReader(folder / LEDGER_FILE) as reader:
        return assemble_dataset(curate(reader, registry, dials, declines=declines), registry, dials)


# --- asking -----------------------------------------------------------------------------------------------------------


def has_held_out_category(one: Sample) -> bool:
    """Whether it is about a thing of a kind that is held out."""
    return any(f"_{kind}" in one.contract for kind in HELD_OUT_CATEGORIES)


SLICES = {
    "known": lambda one: HELD_OUT_FAMILY not in one.scene and not has_held_out_category(one),
    "family": lambda one: f" {HELD_OUT_FAMILY}:" in one.scene,
    "kinds of things": lambda one: HELD_OUT_FAMILY not in one.scene and has_held_out_category(one),
}
"""All in scenes and sentences that were not taught; the last two also in a family or about things that were not."""


@cache
def questions() -> tuple[tuple[str, Sample], ...]:
    """As many questions of each slice, for one robot, without exemplars."""
    drawn = generate_examples(40 * QUESTIONS_PER_SLICE, "test", 7, {ROBOT: 1.0}, exemplar_share=0.0)
    return tuple(
        (name, one) for name, belongs in SLICES.items() for one in list(filter(belongs, drawn))[:QUESTIONS_PER_SLICE]
    )


def evaluate_arm(stack: AdapterStack, prompt: PromptStyle) -> Row:
    """The answers of a model, what became of those that were carried out, and how many draws were valid."""
    speaker, names, samples = FreeAnswerModel(stack), *zip(*questions(), strict=True)
    texts = speaker.generate(samples, [render_prompt(one, prompt) for one in samples])
    answers = [{"slice": name, **told} for name, told in zip(names, map(score_answer, samples, texts), strict=True)]
    draws = sample_compliance(speaker, samples, prompt)
    good = [one for one in answers if is_right(one) and not one["declines"]]
    flights = [
        execute_answer(one) for name in SLICES for one in [x for x in good if x["slice"] == name][:EXECUTED_PER_SLICE]
    ]
    return {"answers": answers, "valid_draws": sum(draws) / len(draws), "flights": flights}


def render_prompt(one: Sample, prompt: PromptStyle) -> list[ChatMessage]:
    """The question as it was taught, with a worked example, or with rules, skills and worked examples."""
    if prompt == "short":
        return one.prompt  # pyright: ignore[reportReturnType]
    asking = build_request(one)
    return render(asking) if prompt == "long" else short_messages(with_example(asking))


def sample_compliance(speaker: FreeAnswerModel, samples: Sequence[Sample], prompt: PromptStyle) -> list[bool]:
    """Whether each of the answers drawn at temperature 1 is compliant; their questions are spread over `samples`."""
    some = [samples[place * len(samples) // N_SAMPLED_ANSWERS] for place in range(N_SAMPLED_ANSWERS)]
    texts = speaker.generate(
        some, [render_prompt(one, prompt) for one in some], Sampling(1.0, range(N_SAMPLED_ANSWERS))
    )
    return [bool(score_answer(one, text)["compliant"]) for one, text in zip(some, texts, strict=True)]


def execute_answer(one: dict[str, Any]) -> dict[str, Any]:
    """What became of an answer: by the robot's own verdict, with the filter on."""
    actions = msgspec.json.decode(one["text"])["action_sequence"]
    outcome = run_contract(open_scene(one["scene"].removeprefix(f"{ROBOT} "), ROBOT), actions, goal=None).outcome
    return {
        "id": one["id"],
        "kind": outcome.kind if outcome else "refused",
        "Delta": outcome.Delta if outcome else None,
    }


# --- figures ----------------------------------------------------------------------------------------------------------


def arm_metrics(row: Row) -> dict[str, float]:
    """Shares in [0, 1]; "quiet": carried out with success and Δ ≤ ε."""
    answers, flights = row["answers"], row["flights"]
    quiet = [one["kind"] == "succeeded" and one["Delta"] is not None and one["Delta"] <= EPSILON for one in flights]
    shares = {what: float(np.mean([one[what] for one in answers])) for what in ("compliant", "skills")}
    shares |= {"right": float(np.mean([is_right(one) for one in answers])), "valid draws": row["valid_draws"]}
    return shares | {"quiet": float(np.mean(quiet)) if quiet else math.nan}


QUESTION_PARTS: dict[str, Callable[[dict[str, Any]], bool]] = {
    "family": lambda one: one["slice"] == "family",
    "kinds of things": lambda one: one["slice"] == "kinds of things",
    "one goal": lambda one: one["goals"] == 1 and not one["declines"],
    "several goals": lambda one: one["goals"] > 1,
    "to be declined": lambda one: one["declines"],
}
"""Parts of the questions."""


def _right_share(row: Row, belongs: Callable[[dict[str, Any]], bool]) -> float:
    """The share of right answers among those that belong."""
    return float(np.mean([is_right(one) for one in row["answers"] if belongs(one)]))


def training_cost(rows: list[Row]) -> tuple[str, str]:
    """Samples and processor seconds of the fits, on average; a fit that was taken up again does not count."""
    fits = [(row["samples"], row["fit_cpu_s"]) for row in rows if "samples" in row]
    return (f"{np.mean([n for n, _ in fits]):.0f}", f"{max(s for _, s in fits):.0f}") if fits else ("-", "-")


STUDENT_T = {2: 12.706, 3: 4.303, 4: 3.182, 5: 2.776}
"""t of a two-sided 95 % interval, by the number of values."""


def format_mean_interval(values: list[float]) -> str:
    """Mean and 95 % interval of the mean."""
    mean = float(np.mean(values))
    half = (
        STUDENT_T.get(len(values), 1.96) * float(np.std(values, ddof=1)) / math.sqrt(len(values))
        if len(values) > 1
        else math.nan
    )
    return f"{mean:.0%}" if math.isnan(half) else f"{mean:.0%} ± {half:.0%}"


NOTES = (
    f"Shares are of the same {len(SLICES) * QUESTIONS_PER_SLICE} questions for all. ± is the spread over seeds, of proposals and "
    "fit together; that these questions were drawn and not others is in no interval, and the base has none at all. "
    f"`quiet` is of at most {len(SLICES) * EXECUTED_PER_SLICE} flights an arm and seed: the first {EXECUTED_PER_SLICE} right deeds "
    "of each slice of the questions, so that arms fly different ones. "
    f"`valid draws` is of {N_SAMPLED_ANSWERS} answers an arm and seed, one drawn for each of {N_SAMPLED_ANSWERS} questions. "
    "Answers are torch's (`experiments/adaptation/free_answers.py`), not those of llama.cpp, which serves.",
)
"""What the tables do not show."""
