"""One chain of rounds: the planner proposes, what it proposed is carried out, what went well is fitted from the base.

The adapter of a round plans in the next one. Nobody else proposes anything. Everything lies in a folder of its own and
is done once: stopped in any way, it goes on where it was.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import msgspec

from dualbrain.adaptation.adapters.base_models import find_base
from dualbrain.adaptation.adapters.card import CARD, AdapterCard, proposed_by_others, read_adapter_card
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.adaptation.adapters.stacking import Stack, stack_of
from dualbrain.adaptation.compliance import gate_judge
from dualbrain.adaptation.config import AdaptConfig, FitDials, ObjectiveDials
from dualbrain.adaptation.curation.curate import Curation, curate
from dualbrain.adaptation.curation.dataset import CARD as DATASET_CARD
from dualbrain.adaptation.curation.dataset import Dataset, dataset_of, read_dataset, write_dataset
from dualbrain.adaptation.curation.sample import Sample, answer
from dualbrain.adaptation.curation.selection import CleanRules
from dualbrain.adaptation.serving.open_planner import author
from dualbrain.adaptation.synthetic.scoring import score
from dualbrain.cli.common import paths
from dualbrain.contracts.contract import Contract
from dualbrain.core.storage.resumable_steps import alone, carry_on
from dualbrain.core.text import storable
from dualbrain.evaluation.runner.run_ledgers import LARGEST_DELTA
from dualbrain.grounding.vocabulary import vocabulary
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.records import Episode
from dualbrain.runtime.data_collection.rollouts import (
    EPSILON,
    LEDGER,
    ROBOT,
    carried_out,
    declined,
    flown,
    memory_of,
    proposals,
    turn_of,
)
from dualbrain.runtime.data_collection.synthetic_scenes import lessons, setting_of
from dualbrain.runtime.planning_time import PLANNING_TIME
from dualbrain.simulation.world import own_goals
from experiments.adaptation.free_answers import Chance, Speaker
from experiments.engine.experiment import Row
from experiments.planning.language import judged, right

if TYPE_CHECKING:
    from dualbrain.adaptation.training.trainer import Progress

BASE = "base-135m"
PLACES, ASKED = 120, 120
"""Held-out places, the same for every round; instructions of a round, others in each."""
TEMPERATURE = 0.7
"""Of what a planner proposes while it gathers experience; where it is measured it answers greedily."""
TOGETHER = 5
"""Held-out episodes in one step."""
HELD_OUT_SEED, FIRST_SEED = 21, 100
"""Of the held-out places; of the first instructions of the first chain."""
DIALS = AdaptConfig(
    curation=Curation(rules=CleanRules(epsilon=EPSILON)),
    fit=FitDials(steps=60, batch=4, at_once=4, save_every=20, ask_at_most=0, threads=1, keep="last"),
)
"""As `adapt_curve` fits. All steps are taken, so that what leaves a part out is fitted for as long."""
CLEAN = DIALS.curation.rules
WITHOUT: dict[str, tuple[CleanRules, ObjectiveDials]] = {
    "adapted_no_entropy": (CLEAN, msgspec.structs.replace(DIALS.objective, lambda_h=0.0, entropy_gate="none")),
    "adapted_no_kl": (CLEAN, msgspec.structs.replace(DIALS.objective, beta=0.0)),
    "adapted_all": (msgspec.structs.replace(CLEAN, physical=False), DIALS.objective),
    "adapted_success": (msgspec.structs.replace(CLEAN, epsilon=LARGEST_DELTA), DIALS.objective),
}
"""By part of suite `ablations`: who may teach, and the objective."""
EPISODES, SECONDS = "episodes.jsonl", "seconds.txt"


@dataclass(frozen=True)
class Chain:
    """The rounds of one `seed` in `folder`; round 0 is the base."""

    seed: int
    folder: Path

    def planner(self, number: int) -> Stack:
        """Who plans in round `number`: the base, or the base with the adapter that all rounds before it led to."""
        folder = self.adapter(number) if number else packaged_folder(BASE)
        return stack_of(folder, paths.cache())

    def adapter(self, number: int) -> Path:
        """What the rounds before `number` taught, always fitted from the base; the folder with its card."""
        return self._fitted(number, self.folder / f"fit {number}", DIALS.objective, CLEAN)

    def without(self, number: int, part: str) -> Path:
        """The same, of the same flights, with a part of adaptation left out."""
        rules, objective = WITHOUT[part]
        return self._fitted(number, self.folder / f"fit {number}, {part}", objective, rules)

    def _fitted(self, number: int, folder: Path, objective: ObjectiveDials, rules: CleanRules) -> Path:
        with alone(folder):
            if not (folder / "adapter" / CARD).is_file():
                own = [read_adapter_card(self.adapter(earlier)).id for earlier in range(1, number)]
                if not (folder / "dataset" / DATASET_CARD).is_file():
                    data = chosen(self.lived(number) / LEDGER, self.impossible(number), rules, own)
                    write_dataset(data, folder / "dataset")
                fit(read_dataset(folder / "dataset"), self.seed, folder, objective, own)
        return folder / "adapter"

    def lived(self, number: int) -> Path:
        """The folder with the ledger of everything that was proposed in the rounds before `number`."""
        last, start = number - 1, self.lived(number - 1) if number > 1 else None
        first = last * ASKED
        stack = self.planner(last)
        speaker, name = Speaker(stack), author(stack.layers[-1].folder.name, stack)

        def propose(turn: int) -> Sample:
            question = instructions(self.seed, last)[turn - first]
            text = speaker.answer(question, Chance(TEMPERATURE, [turn]))
            return said_by(question, storable(text), name)

        folder = self.folder / f"proposed in round {last}"
        return flown(folder, ASKED, propose, first=first, start=start, cache=paths.cache())

    def impossible(self, number: int) -> list[str]:
        """The memories of what was asked for before round `number` and cannot be done: declines may teach there."""
        asked = [one for last in range(number) for one in instructions(self.seed, last)]
        return [memory_of(turn) for turn, one in enumerate(asked) if declined(one)]

    def taught(self, number: int) -> Row:
        """What the adapter of round `number` was taught, and what that cost."""
        folder = self.adapter(number).parent
        card, data = read_adapter_card(folder / "adapter"), read_dataset(folder / "dataset")
        return {
            "adapter": card.id, "base_sha256": card.base_sha256, "bootstrapped": card.bootstrapped,
            "sources": card.sources, "dataset": card.dataset, "proposed": data.card.memories,
            "samples": data.card.train, "as_said": sum(self.as_said(one) for one in data.train),
            "left_out": data.card.left_out, "fit_s": seconds(folder / SECONDS),
        }  # fmt: skip

    def as_said(self, one: Sample) -> bool:
        """Whether what is taught does what its instruction says: nobody looks at that when it is chosen."""
        last, place = divmod(turn_of(one.memory), ASKED)
        question = instructions(self.seed, last)[place]
        return score(one.contract, question.contract, vocabulary(ROBOT), lambda text: True).right

    def measured(self, number: int) -> list[Row]:
        """The held-out episodes of the planner of round `number`; of round 0 they are the same in every chain."""
        stack = self.planner(number)
        speaker, name = Speaker(stack), author(stack.layers[-1].folder.name, stack)

        def some(step: int, here: Path) -> None:
            turns = range(step * TOGETHER, min(PLACES, (step + 1) * TOGETHER))
            texts = speaker.answers([places()[turn] for turn in turns])
            with (here / EPISODES).open("ab") as lines:
                for turn, text in zip(turns, texts, strict=True):
                    lines.write(msgspec.json.encode(episode(turn, storable(text), name)) + b"\n")

        last = carry_on(self.folder / f"measured in round {number}", -(-PLACES // TOGETHER), some)
        return [msgspec.json.decode(line) for line in (last / EPISODES).read_bytes().splitlines()]


# --- questions --------------------------------------------------------------------------------------------------------


def one_goal(question: Sample) -> bool:
    """Whether one thing is asked for, which takes two actions at most.

    Of several the base does the first, and its body calls that a success: it would teach itself to stop there.
    """
    return question.contract.count('"skill":') <= 2


@cache
def places() -> tuple[Sample, ...]:
    """Scenes and words of the held-out part, as they come, with one goal; about one in eight is to be declined."""
    drawn = lessons(2 * PLACES, "test", HELD_OUT_SEED, {ROBOT: 1.0}, exemplars=0.0)
    return tuple(filter(one_goal, drawn))[:PLACES]


@cache
def instructions(seed: int, number: int) -> tuple[Sample, ...]:
    """What the planner of a round is asked for in the chain of `seed`: one goal each, scenes and words of lessons."""
    drawn = proposals(FIRST_SEED + 10 * seed + number, 2 * ASKED, declines=True)
    return tuple(filter(one_goal, drawn))[:ASKED]


def said_by(question: Sample, text: str, name: str) -> Sample:
    """The question with what `name` answered."""
    return msgspec.structs.replace(question, completion=answer(text), source=name)


# --- teaching ---------------------------------------------------------------------------------------------------------


def chosen(ledger: Path, declines: Sequence[str], rules: CleanRules = CLEAN, own: Sequence[str] = ()) -> Dataset:
    """What `rules` let in of the ledger, in which only the model that is adapted has proposed anything.

    `declines` are the right ones, `own` the ids of its adapters in the rounds before.
    """
    registry, dials = vocabulary(ROBOT), msgspec.structs.replace(DIALS.curation, rules=rules)
    with LedgerReader(ledger) as reader:
        data = dataset_of(curate(reader, registry, dials, declines=declines), registry, dials)
    assert not proposed_by_others(data.card.sources, BASE, own), data.card.sources
    return data


def fit(data: Dataset, seed: int, folder: Path, objective: ObjectiveDials, own: Sequence[str] = ()) -> AdapterCard:
    """Fit an adapter of the base in `folder`, or go on with the fit there; `own` are its adapters of before."""
    from dualbrain.adaptation.training.train import adapt  # noqa: PLC0415  (torch, only where something is fitted)

    fits = msgspec.structs.replace(DIALS.fit, seed=seed)
    config = msgspec.structs.replace(DIALS, objective=objective, fit=fits)
    with (folder / SECONDS).open("a", buffering=1) as told:
        return adapt(
            data, config, find_base(BASE, paths.cache()), gate_judge(vocabulary(ROBOT)), folder,
            cache=paths.cache(), clock=time.monotonic, tell=step_times(told, time.monotonic), own=own,
        )  # fmt: skip


def step_times(told: TextIO, clock: Callable[[], float]) -> Callable[[Progress], None]:
    """Writes a line for each step: its number and how long it took [s], the first one with all that comes before it."""
    last = [clock()]

    def tell(progress: Progress) -> None:
        last.append(clock())
        print(progress.step, last[-1] - last[-2], file=told)

    return tell


def seconds(path: Path) -> float:
    """How long a fit took [s]; a step that was taken again after a stop counts once."""
    return sum({step: float(took) for step, took in (line.split() for line in path.read_text().splitlines())}.values())


# --- measuring --------------------------------------------------------------------------------------------------------


def episode(turn: int, text: str, name: str) -> Row:
    """One held-out place: the answer judged, and carried out if the gate accepts it.

    "success": the answer does what was said, the robot says so, and where something was put truth agrees; where nothing
    can be done, nothing moved.
    """
    question = places()[turn]
    told, one = judged(question, text), said_by(question, text, name)
    row: Row = {
        "id": question.id, "scene": question.scene, "text": text, "to_decline": told["declines"],
        "compliant": bool(told["compliant"]), "right": right(told),
    }  # fmt: skip
    if not setting_of(question.scene).accepts(text.encode()):
        ended = unmoved("rejected")
    elif declined(one):
        ended = unmoved("declined")
    else:
        with tempfile.TemporaryDirectory(prefix="dualbrain-rounds-") as folder:
            flight = carried_out(one, Path(folder) / LEDGER, turn, cache=paths.cache())
        ended = became(flight)
    moved = ended["completion_s"] is not None
    return {**row, **ended, "success": not moved if row["to_decline"] else row["right"] and ended["done"]}


def unmoved(outcome: str) -> Row:
    """Nothing was carried out."""
    return {"outcome": outcome, "Delta": None, "frequency": None, "completion_s": None, "done": False, "violations": 0}


def became(flight: Episode) -> Row:
    """What became of a contract that was carried out; [s] from the question, with the time that any planner is given.

    "done": the robot says that it succeeded, and where it put something somewhere truth agrees.
    """
    outcome, judgement = flight.outcome, flight.judgement
    if flight.contract is None:
        return unmoved(outcome.kind)
    puts = own_goals(msgspec.convert(flight.contract, Contract)) is not None
    truth = not puts or bool(judgement and judgement.success)
    return {
        "outcome": outcome.kind, "Delta": outcome.Delta, "frequency": outcome.intervention_frequency,
        "completion_s": PLANNING_TIME + outcome.duration, "done": outcome.kind == "succeeded" and truth,
        "violations": len(judgement.violations) if judgement else 0,
    }  # fmt: skip
