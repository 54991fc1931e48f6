"""The contribution of each part of adaptation, measured by unconstrained answers to held-out requests.

Every arm starts from base-135m. All arms of a seed share the same executed proposals; they differ in the selection of
training samples and in the objective. Answers are decoded greedily without a grammar; those that the gate accepts are
executed in their scenes.
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
from dualbrain.core import paths
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
from experiments.planning.language import is_right, score_question
from experiments.safety.closed_loop import run_contract

SEEDS, N_EXECUTED, N_PROPOSALS = range(3), 240, 280
"""Proposals of a seed that are executed; number of proposals from which the declines are taken."""
N_STEPS, N_STEPS_HALF, BATCH_SIZE = 60, 30, 4
"""Steps of a training run, and of a shorter one with the same final learning rate; samples per step."""
QUESTIONS_PER_SLICE, EXECUTED_PER_SLICE, N_SAMPLED_ANSWERS = 20, 6, 16
"""Requests of each slice; executed answers of each slice; answers drawn at temperature 1, for as many requests."""
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
"""By arm: whether it trains on clean episodes only, and its objective. No memory was retrieved in the episodes, so all
memories have the weight of a new one, and λ_w does not distinguish samples; no arm leaves it out."""
PromptStyle = Literal["short", "example", "long"]
UNTRAINED_ARMS: dict[str, PromptStyle] = {
    "base": "short",
    "base, worked example": "example",
    "base, long prompt": "long",
}
"""Arms without training, by prompt: the one of training; with a worked example; with rules, skills and examples."""
ALSO_AT_HALF_STEPS, SINGLE_SEED_ARMS = ("full",), ("EAFT's gate",)
"""Arms that are also trained for half of the steps, and arms of one seed only."""
METRICS = {
    "compliant": "compliant",
    "skills": "correct skills",
    "right": "correct",
    "quiet": "without intervention",
    "valid draws": "valid draws",
}
"""Column headings by metric."""


class AblationCurve:
    """The contribution of each part of adaptation."""

    name = "ablation_curve"
    claim = (
        f"From {N_EXECUTED} random valid proposals, each executed once: one-shot compliance of unconstrained answers, "
        "correct skills, correct objects, and parameters that need no intervention, by arm, after "
        f"{N_STEPS_HALF} and {N_STEPS} steps of {BATCH_SIZE} samples. All memories have the same weight, so the memory "
        "weight, one of the three parts of the objective, has no effect in any arm."
    )
    intervals = f"Student's t over {len(SEEDS)} seeds, 95 %, none for an arm of one seed"

    def units(self, options: Options) -> list[WorkUnit]:
        """The arms without training, then seed by seed the full training runs, then the shorter ones."""
        trained = [
            (seed, arm, N_STEPS) for seed in SEEDS for arm in TRAINED_ARMS if seed == 0 or arm not in SINGLE_SEED_ARMS
        ]
        trained += [(seed, arm, N_STEPS_HALF) for seed in SEEDS for arm in ALSO_AT_HALF_STEPS]
        folder = str(options.folder / self.name)
        return [
            WorkUnit(f"{arm}, seed {seed}, {steps} steps", {"arm": arm, "seed": seed, "steps": steps, "folder": folder})
            for seed, arm, steps in [*((0, arm, 0) for arm in UNTRAINED_ARMS), *trained]
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Train the arm if it has training, generate answers greedily and by sampling, execute them."""
        arm, seed, steps, folder = (
            parameters["arm"],
            parameters["seed"],
            parameters["steps"],
            Path(parameters["folder"]),
        )
        row: Row = {"arm": arm, "seed": seed, "steps": steps}
        stack = load_stack(packaged_folder("base-135m"), paths.cache_folder())
        if steps:
            row |= train_arm(arm, seed, steps, folder)
            stack = load_stack(training_folder(arm, seed, steps, folder) / "adapter", paths.cache_folder())
        return row | evaluate_arm(stack, UNTRAINED_ARMS.get(arm, "short"))

    def summarize_row(self, row: Row) -> str:
        """The metrics."""
        return ", ".join(f"{metric} {value:.0%}" for metric, value in arm_metrics(row).items())

    def report(self, rows: list[Row]) -> list[str]:
        """Every arm and number of steps: means over seeds with their 95 % intervals (Student's t)."""
        keys = sorted({(row["steps"], row["arm"]) for row in rows})
        cells: list[tuple[object, ...]] = []
        for steps, arm in keys:
            metrics = [arm_metrics(row) for row in rows if (row["steps"], row["arm"]) == (steps, arm)]
            means = (format_mean_interval([one[metric] for one in metrics]) for metric in METRICS)
            cells.append((arm, steps, len(metrics), *means))
        lines = markdown_table(("arm", "steps", "seeds", *METRICS.values()), cells)
        lines += ["Correct answers by held-out property and by type of request:", ""]
        parts: list[tuple[object, ...]] = []
        for steps, arm in keys:
            some = [row for row in rows if (row["steps"], row["arm"]) == (steps, arm)]
            shares = (
                format_mean_interval([_right_share(row, belongs) for row in some])
                for belongs in QUESTION_PARTS.values()
            )
            parts.append((arm, steps, *shares, *training_cost(some)))
        lines += markdown_table(("arm", "steps", *QUESTION_PARTS, "samples", "processor time of training [s]"), parts)
        return [*lines, *NOTES, ""]


# --- training ---------------------------------------------------------------------------------------------------------


def training_folder(arm: str, seed: int, steps: int, folder: Path) -> Path:
    """The folder of a training run."""
    return folder / f"{arm.replace(' ', '-').replace(',', '')}-seed-{seed}-{steps}"


def train_arm(arm: str, seed: int, steps: int, folder: Path) -> Row:
    """Train the arm, or continue its training; returns the fields about its data and cost."""
    from dualbrain.adaptation.training.train import adapt  # noqa: PLC0415  (imports torch)

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
    wall_start, cpu_start = time.monotonic(), time.process_time()
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
    cost = {"fit_s": time.monotonic() - wall_start, "fit_cpu_s": time.process_time() - cpu_start}
    return {"adapter": card.id, "samples": len(data.train), "dataset": data.card.hash, **cost}


def collect_rollouts(folder: Path, seed: int) -> Path:
    """The folder of the episodes from which all arms of a seed learn, with the correct declines among the proposals."""
    executed, proposals = folder / "proposals" / f"seed {seed}, {N_EXECUTED} flights", draw_proposals(seed, N_EXECUTED)
    start = run_proposals(executed, N_EXECUTED, proposals.__getitem__, cache=paths.cache_folder())
    declined = [one for one in draw_proposals(seed, N_PROPOSALS, include_declines=True) if is_declined(one)]
    complete = executed.with_name(f"{executed.name}, {len(declined)} declines")

    def propose(turn: int) -> Sample:
        return declined[turn - N_EXECUTED]

    return run_proposals(
        complete, len(declined), propose, cache=paths.cache_folder(), first_turn=N_EXECUTED, initial_folder=start
    )


def training_data(folder: Path, *, clean: bool) -> Dataset:
    """The data set from the episodes in `folder`: the clean ones, or all proposals regardless of their outcome."""
    registry, config = load_skill_registry(ROBOT), AdaptConfig().curation
    config = msgspec.structs.replace(config, rules=CleanRules(epsilon=EPSILON, physical=clean))
    declines = [memory_id_of_turn(turn) for turn, one in enumerate(load_proposals(folder)) if is_declined(one)]
    with LedgerReader(folder / LEDGER_FILE) as reader:
        return assemble_dataset(curate(reader, registry, config, declines=declines), registry, config)


# --- evaluation -------------------------------------------------------------------------------------------------------


def has_held_out_category(one: Sample) -> bool:
    """Whether the contract names an object of a held-out kind."""
    return any(f"_{kind}" in one.contract for kind in HELD_OUT_CATEGORIES)


SLICES = {
    "known": lambda one: HELD_OUT_FAMILY not in one.scene and not has_held_out_category(one),
    "family": lambda one: f" {HELD_OUT_FAMILY}:" in one.scene,
    "kinds of things": lambda one: HELD_OUT_FAMILY not in one.scene and has_held_out_category(one),
}
"""Slices of the requests, all in held-out scenes and sentences; the last two also in a held-out family, or about
held-out kinds of objects."""


@cache
def questions() -> tuple[tuple[str, Sample], ...]:
    """The same number of requests of each slice, for one robot, without exemplars."""
    drawn = generate_examples(40 * QUESTIONS_PER_SLICE, "test", 7, {ROBOT: 1.0}, exemplar_share=0.0)
    return tuple(
        (name, one) for name, belongs in SLICES.items() for one in list(filter(belongs, drawn))[:QUESTIONS_PER_SLICE]
    )


def evaluate_arm(stack: AdapterStack, prompt: PromptStyle) -> Row:
    """The scored answers of a model, the outcomes of the executed ones, and the share of valid sampled answers."""
    model, names, samples = FreeAnswerModel(stack), *zip(*questions(), strict=True)
    texts = model.generate(samples, [render_prompt(one, prompt) for one in samples])
    answers = [{"slice": name, **score} for name, score in zip(names, map(score_question, samples, texts), strict=True)]
    draws = sample_compliance(model, samples, prompt)
    good = [one for one in answers if is_right(one) and not one["declines"]]
    outcomes = [
        execute_answer(one) for name in SLICES for one in [x for x in good if x["slice"] == name][:EXECUTED_PER_SLICE]
    ]
    return {"answers": answers, "valid_draws": sum(draws) / len(draws), "flights": outcomes}


def render_prompt(one: Sample, prompt: PromptStyle) -> list[ChatMessage]:
    """The prompt: that of training, with a worked example, or with rules, skills and worked examples."""
    if prompt == "short":
        return one.prompt  # pyright: ignore[reportReturnType]
    request = build_request(one)
    return render(request) if prompt == "long" else short_messages(with_example(request))


def sample_compliance(model: FreeAnswerModel, samples: Sequence[Sample], prompt: PromptStyle) -> list[bool]:
    """Compliance of each answer drawn at temperature 1; the requests are spread over `samples`."""
    some = [samples[place * len(samples) // N_SAMPLED_ANSWERS] for place in range(N_SAMPLED_ANSWERS)]
    texts = model.generate(some, [render_prompt(one, prompt) for one in some], Sampling(1.0, range(N_SAMPLED_ANSWERS)))
    return [bool(score_question(one, text)["compliant"]) for one, text in zip(some, texts, strict=True)]


def execute_answer(one: dict[str, Any]) -> dict[str, Any]:
    """The outcome of an executed answer according to the robot, with the filter on."""
    actions = msgspec.json.decode(one["text"])["action_sequence"]
    outcome = run_contract(open_scene(one["scene"].removeprefix(f"{ROBOT} "), ROBOT), actions, goal=None).outcome
    return {
        "id": one["id"],
        "kind": outcome.kind if outcome else "refused",
        "Delta": outcome.Delta if outcome else None,
    }


# --- figures ----------------------------------------------------------------------------------------------------------


def arm_metrics(row: Row) -> dict[str, float]:
    """The metrics as shares in [0, 1]; "quiet": executed with success and Δ ≤ ε."""
    answers, outcomes = row["answers"], row["flights"]
    quiet = [one["kind"] == "succeeded" and one["Delta"] is not None and one["Delta"] <= EPSILON for one in outcomes]
    shares = {metric: float(np.mean([one[metric] for one in answers])) for metric in ("compliant", "skills")}
    shares |= {"right": float(np.mean([is_right(one) for one in answers])), "valid draws": row["valid_draws"]}
    return shares | {"quiet": float(np.mean(quiet)) if quiet else math.nan}


QUESTION_PARTS: dict[str, Callable[[dict[str, Any]], bool]] = {
    "held-out family": lambda one: one["slice"] == "family",
    "held-out kinds of objects": lambda one: one["slice"] == "kinds of things",
    "one goal": lambda one: one["goals"] == 1 and not one["declines"],
    "several goals": lambda one: one["goals"] > 1,
    "to be declined": lambda one: one["declines"],
}
"""Parts of the requests."""


def _right_share(row: Row, belongs: Callable[[dict[str, Any]], bool]) -> float:
    """The share of correct answers in one part of the requests."""
    return float(np.mean([is_right(one) for one in row["answers"] if belongs(one)]))


def training_cost(rows: list[Row]) -> tuple[str, str]:
    """Mean number of training samples, and the largest processor time [s] (a resumed training run has only a part)."""
    fits = [(row["samples"], row["fit_cpu_s"]) for row in rows if "samples" in row]
    return (f"{np.mean([n for n, _ in fits]):.0f}", f"{max(s for _, s in fits):.0f}") if fits else ("-", "-")


STUDENT_T = {2: 12.706, 3: 4.303, 4: 3.182, 5: 2.776}
"""Quantile of Student's t for a two-sided 95 % interval, by the number of values."""


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
    f"Shares refer to the same {len(SLICES) * QUESTIONS_PER_SLICE} requests for all arms. ± covers the spread over "
    "seeds, of proposals and training together; the choice of the requests is in no interval, and the base has no "
    f"interval. *Without intervention* refers to at most {len(SLICES) * EXECUTED_PER_SLICE} episodes per arm and seed: "
    f"the first {EXECUTED_PER_SLICE} correct contracts of each slice, so the arms execute different ones. *Valid "
    f"draws* refers to {N_SAMPLED_ANSWERS} answers per arm and seed, one drawn for each of {N_SAMPLED_ANSWERS} "
    "requests. The answers are torch's (`experiments/adaptation/free_answers.py`), not those of llama.cpp, which "
    "serves the planner.",
)
"""Notes on the tables."""
