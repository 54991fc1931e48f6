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

from dualbrain.adaptation.adapters.base_models import find_base
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.adaptation.adapters.stacking import Stack, stack_of
from dualbrain.adaptation.compliance import gate_judge
from dualbrain.adaptation.config import AdaptConfig, FitDials, ObjectiveDials
from dualbrain.adaptation.curation.curate import curate
from dualbrain.adaptation.curation.dataset import Dataset, dataset_of
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.curation.selection import CleanRules
from dualbrain.adaptation.synthetic.split import HELD_OUT_CATEGORIES, HELD_OUT_FAMILY
from dualbrain.cli.common import paths
from dualbrain.evaluation.planners.few_shot import with_example
from dualbrain.grounding.vocabulary import vocabulary
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.planner.prompt.full_prompt import Message, render
from dualbrain.planner.prompt.prompt_format import short_messages
from dualbrain.runtime.data_collection.rollouts import (
    EPSILON,
    LEDGER,
    ROBOT,
    declined,
    flown,
    memory_of,
    proposals,
    proposed,
    request_of,
)
from dualbrain.runtime.data_collection.synthetic_scenes import lessons
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from experiments.adaptation.free_answers import Chance, Speaker
from experiments.engine.experiment import Options, Row, Unit
from experiments.figures.tables import table
from experiments.planning.language import judged, right
from experiments.safety.closed_loop import fly

SEEDS, FLIGHTS, REACHED = range(3), 240, 280
"""Of the lessons of a seed so many are deeds that are flown; what is declined comes from the first so many."""
STEPS, HALFWAY, BATCH = 60, 30, 4
"""Of a fit, and of a shorter one beside it, whose rate falls as far; samples of a step."""
A_SLICE, CARRIED_OUT, DRAWS = 20, 6, 16
"""Questions of each slice, answers of each that are carried out, draws at temperature 1 of all, each of another."""
PLAIN = ObjectiveDials(lambda_w=0.0, lambda_h=0.0, beta=0.0, entropy_gate="none")
FULL = ObjectiveDials()
TAUGHT: dict[str, tuple[bool, ObjectiveDials]] = {
    "full": (True, FULL),
    "sft, all proposals": (False, PLAIN),
    "sft, clean ones": (True, PLAIN),
    "+ entropy": (True, msgspec.structs.replace(PLAIN, lambda_h=FULL.lambda_h, entropy_gate="sample")),
    "+ KL": (True, msgspec.structs.replace(PLAIN, beta=FULL.beta)),
    "EAFT's gate": (True, msgspec.structs.replace(PLAIN, entropy_gate="token")),
}
"""By arm: whether only clean episodes are taught, and the objective. Nothing was recalled in the flights, so that all
memories have the weight of a new one, and λ_w tells no samples apart; no arm leaves it out."""
Prompt = Literal["short", "example", "long"]
ASKED_ONLY: dict[str, Prompt] = {"base": "short", "base, worked example": "example", "base, long prompt": "long"}
"""Arms without a fit, by their prompt: as it was taught; with a worked example in it; rules, skills and examples."""
HALF_AS_WELL, ONCE = ("full",), ("EAFT's gate",)
"""Arms that are also fitted for half of the steps, and those of one seed only."""
MEASURES = ("compliant", "skills", "right", "quiet", "valid draws")


class AdaptCurve:
    """What adaptation is worth, part by part."""

    name = "ablation_curve"
    claim = (
        f"From {FLIGHTS} random valid proposals, each carried out once: free one-shot compliance, right skills, right "
        f"things, and parameters that the filter leaves alone, by arm, after {HALFWAY} and {STEPS} steps of {BATCH}. "
        "All memories have one weight: of the objective's three parts the memory weight is at rest, in every arm."
    )
    intervals = f"Student's t over {len(SEEDS)} seeds, 95 %, none for an arm of one seed"

    def units(self, options: Options) -> list[Unit]:
        """The arms that need no fit, then seed by seed the whole fits, then the shorter ones."""
        fits = [(seed, arm, STEPS) for seed in SEEDS for arm in TAUGHT if seed == 0 or arm not in ONCE]
        fits += [(seed, arm, HALFWAY) for seed in SEEDS for arm in HALF_AS_WELL]
        folder = str(options.folder / self.name)
        return [
            Unit(f"{arm}, seed {seed}, {steps} steps", {"arm": arm, "seed": seed, "steps": steps, "folder": folder})
            for seed, arm, steps in [*((0, arm, 0) for arm in ASKED_ONLY), *fits]
        ]

    def run(self, about: dict[str, Any]) -> Row:
        """Fit if the arm is taught, ask, draw, carry out."""
        arm, seed, steps, folder = about["arm"], about["seed"], about["steps"], Path(about["folder"])
        row: Row = {"arm": arm, "seed": seed, "steps": steps}
        stack = stack_of(packaged_folder("base-135m"), paths.cache())
        if steps:
            row |= fit(arm, seed, steps, folder)
            stack = stack_of(place(arm, seed, steps, folder) / "adapter", paths.cache())
        return row | asked(stack, ASKED_ONLY.get(arm, "short"))

    def brief(self, row: Row) -> str:
        """The measures."""
        return ", ".join(f"{what} {value:.0%}" for what, value in measures(row).items())

    def report(self, rows: list[Row]) -> list[str]:
        """Every arm at every length: means over seeds and their 95 % intervals (Student, over seeds)."""
        keys = sorted({(row["steps"], row["arm"]) for row in rows})
        cells: list[tuple[object, ...]] = []
        for steps, arm in keys:
            mine = [measures(row) for row in rows if (row["steps"], row["arm"]) == (steps, arm)]
            cells.append((arm, steps, len(mine), *(interval([one[what] for one in mine]) for what in MEASURES)))
        lines = table(("arm", "steps", "seeds", *MEASURES), cells)
        lines += ["Right, by what had not been taught and by what is asked:", ""]
        parts: list[tuple[object, ...]] = []
        for steps, arm in keys:
            mine = [row for row in rows if (row["steps"], row["arm"]) == (steps, arm)]
            told = (interval([_share(row, belongs) for row in mine]) for belongs in PARTS.values())
            parts.append((arm, steps, *told, *cost(mine)))
        lines += table(("arm", "steps", *PARTS, "samples", "processor s of a fit"), parts)
        return [*lines, *NOTES, ""]


# --- teaching ---------------------------------------------------------------------------------------------------------


def place(arm: str, seed: int, steps: int, folder: Path) -> Path:
    """Where a fit lies."""
    return folder / f"{arm.replace(' ', '-').replace(',', '')}-seed-{seed}-{steps}"


def fit(arm: str, seed: int, steps: int, folder: Path) -> Row:
    """Fit the arm, or go on where its fit was; what it was taught and what that cost."""
    from dualbrain.adaptation.training.train import adapt  # noqa: PLC0415  (torch, only where something is fitted)

    clean, objective = TAUGHT[arm]
    config = AdaptConfig(
        objective=objective,
        fit=FitDials(
            steps=steps, batch=BATCH, at_once=BATCH, seed=seed, save_every=25, ask_at_most=0, threads=1, keep="last"
        ),
    )
    data = taught(day(folder, seed), clean=clean)
    began, busy = time.monotonic(), time.process_time()
    card = adapt(
        data, config, find_base("base-135m", paths.cache()), gate_judge(vocabulary(ROBOT)),
        place(arm, seed, steps, folder), cache=paths.cache(), clock=time.monotonic, tell=lambda progress: None,
    )  # fmt: skip
    cost = {"fit_s": time.monotonic() - began, "fit_cpu_s": time.process_time() - busy}
    return {"adapter": card.id, "samples": len(data.train), "dataset": data.card.hash, **cost}


def day(folder: Path, seed: int) -> Path:
    """The flights that all arms of a seed learn from, and what was rightly declined between them."""
    kept, wanted = folder / "proposals" / f"seed {seed}, {FLIGHTS} flights", proposals(seed, FLIGHTS)
    deeds = flown(kept, FLIGHTS, wanted.__getitem__, cache=paths.cache())
    refused = [one for one in proposals(seed, REACHED, declines=True) if declined(one)]
    whole = kept.with_name(f"{kept.name}, {len(refused)} declines")

    def propose(turn: int) -> Sample:
        return refused[turn - FLIGHTS]

    return flown(whole, len(refused), propose, cache=paths.cache(), first=FLIGHTS, start=deeds)


def taught(folder: Path, *, clean: bool) -> Dataset:
    """What is taught of the flights in `folder`: the clean ones, or all that was proposed, whatever became of it."""
    registry, dials = vocabulary(ROBOT), AdaptConfig().curation
    dials = msgspec.structs.replace(dials, rules=CleanRules(epsilon=EPSILON, physical=clean))
    declines = [memory_of(turn) for turn, one in enumerate(proposed(folder)) if declined(one)]
    with LedgerReader(folder / LEDGER) as reader:
        return dataset_of(curate(reader, registry, dials, declines=declines), registry, dials)


# --- asking -----------------------------------------------------------------------------------------------------------


def unknown_kind(one: Sample) -> bool:
    """Whether it is about a thing of a kind that is held out."""
    return any(f"_{kind}" in one.contract for kind in HELD_OUT_CATEGORIES)


SLICES = {
    "known": lambda one: HELD_OUT_FAMILY not in one.scene and not unknown_kind(one),
    "family": lambda one: f" {HELD_OUT_FAMILY}:" in one.scene,
    "kinds of things": lambda one: HELD_OUT_FAMILY not in one.scene and unknown_kind(one),
}
"""All in scenes and sentences that were not taught; the last two also in a family or about things that were not."""


@cache
def questions() -> tuple[tuple[str, Sample], ...]:
    """As many questions of each slice, for one robot, without exemplars."""
    drawn = lessons(40 * A_SLICE, "test", 7, {ROBOT: 1.0}, exemplars=0.0)
    return tuple((name, one) for name, belongs in SLICES.items() for one in list(filter(belongs, drawn))[:A_SLICE])


def asked(stack: Stack, prompt: Prompt) -> Row:
    """The answers of a model, what became of those that were carried out, and how many draws were valid."""
    speaker, names, samples = Speaker(stack), *zip(*questions(), strict=True)
    texts = speaker.answers(samples, [turns(one, prompt) for one in samples])
    answers = [{"slice": name, **told} for name, told in zip(names, map(judged, samples, texts), strict=True)]
    draws = drawn(speaker, samples, prompt)
    good = [one for one in answers if right(one) and not one["declines"]]
    flights = [flight(one) for name in SLICES for one in [x for x in good if x["slice"] == name][:CARRIED_OUT]]
    return {"answers": answers, "valid_draws": sum(draws) / len(draws), "flights": flights}


def turns(one: Sample, prompt: Prompt) -> list[Message]:
    """The question as it was taught, with a worked example, or with rules, skills and worked examples."""
    if prompt == "short":
        return one.prompt  # pyright: ignore[reportReturnType]
    asking = request_of(one)
    return render(asking) if prompt == "long" else short_messages(with_example(asking))


def drawn(speaker: Speaker, samples: Sequence[Sample], prompt: Prompt) -> list[bool]:
    """Whether each of the answers drawn at temperature 1 is compliant; their questions are spread over `samples`."""
    some = [samples[place * len(samples) // DRAWS] for place in range(DRAWS)]
    texts = speaker.answers(some, [turns(one, prompt) for one in some], Chance(1.0, range(DRAWS)))
    return [bool(judged(one, text)["compliant"]) for one, text in zip(some, texts, strict=True)]


def flight(one: dict[str, Any]) -> dict[str, Any]:
    """What became of an answer: by the robot's own verdict, with the filter on."""
    actions = msgspec.json.decode(one["text"])["action_sequence"]
    outcome = fly(open_scene(one["scene"].removeprefix(f"{ROBOT} "), ROBOT), actions, goal=None).outcome
    return {
        "id": one["id"],
        "kind": outcome.kind if outcome else "refused",
        "Delta": outcome.Delta if outcome else None,
    }


# --- figures ----------------------------------------------------------------------------------------------------------


def measures(row: Row) -> dict[str, float]:
    """Shares in [0, 1]; "quiet": carried out with success and Δ ≤ ε."""
    answers, flights = row["answers"], row["flights"]
    quiet = [one["kind"] == "succeeded" and one["Delta"] is not None and one["Delta"] <= EPSILON for one in flights]
    shares = {what: float(np.mean([one[what] for one in answers])) for what in ("compliant", "skills")}
    shares |= {"right": float(np.mean([right(one) for one in answers])), "valid draws": row["valid_draws"]}
    return shares | {"quiet": float(np.mean(quiet)) if quiet else math.nan}


PARTS: dict[str, Callable[[dict[str, Any]], bool]] = {
    "family": lambda one: one["slice"] == "family",
    "kinds of things": lambda one: one["slice"] == "kinds of things",
    "one goal": lambda one: one["goals"] == 1 and not one["declines"],
    "several goals": lambda one: one["goals"] > 1,
    "to be declined": lambda one: one["declines"],
}
"""Parts of the questions."""


def _share(row: Row, belongs: Callable[[dict[str, Any]], bool]) -> float:
    """The share of right answers among those that belong."""
    return float(np.mean([right(one) for one in row["answers"] if belongs(one)]))


def cost(rows: list[Row]) -> tuple[str, str]:
    """Samples and processor seconds of the fits, on average; a fit that was taken up again does not count."""
    fits = [(row["samples"], row["fit_cpu_s"]) for row in rows if "samples" in row]
    return (f"{np.mean([n for n, _ in fits]):.0f}", f"{max(s for _, s in fits):.0f}") if fits else ("-", "-")


STUDENT = {2: 12.706, 3: 4.303, 4: 3.182, 5: 2.776}
"""t of a two-sided 95 % interval, by the number of values."""


def interval(values: list[float]) -> str:
    """Mean and 95 % interval of the mean."""
    mean = float(np.mean(values))
    half = (
        STUDENT.get(len(values), 1.96) * float(np.std(values, ddof=1)) / math.sqrt(len(values))
        if len(values) > 1
        else math.nan
    )
    return f"{mean:.0%}" if math.isnan(half) else f"{mean:.0%} ± {half:.0%}"


NOTES = (
    f"Shares are of the same {len(SLICES) * A_SLICE} questions for all. ± is the spread over seeds, of proposals and "
    "fit together; that these questions were drawn and not others is in no interval, and the base has none at all. "
    f"`quiet` is of at most {len(SLICES) * CARRIED_OUT} flights an arm and seed: the first {CARRIED_OUT} right deeds "
    "of each slice of the questions, so that arms fly different ones. "
    f"`valid draws` is of {DRAWS} answers an arm and seed, one drawn for each of {DRAWS} questions. "
    "Answers are torch's (`experiments/adaptation/free_answers.py`), not those of llama.cpp, which serves.",
)
"""What the tables do not show."""
