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

from dualbrain.adaptation.adapters.base_models import find_base_model
from dualbrain.adaptation.adapters.card import CARD_FILE, AdapterCard, has_foreign_proposals, read_adapter_card
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.adaptation.adapters.stacking import AdapterStack, load_stack
from dualbrain.adaptation.compliance import make_gate_judge
from dualbrain.adaptation.config import AdaptConfig, FitConfig, ObjectiveConfig
from dualbrain.adaptation.curation.curate import CurationConfig, curate
from dualbrain.adaptation.curation.dataset import CARD_FILE as DATASET_CARD
from dualbrain.adaptation.curation.dataset import Dataset, assemble_dataset, read_dataset, write_dataset
from dualbrain.adaptation.curation.sample import Sample, assistant_turn
from dualbrain.adaptation.curation.selection import CleanRules
from dualbrain.adaptation.serving.open_planner import proposal_author
from dualbrain.adaptation.synthetic.scoring import score_answer
from dualbrain.cli.common import paths
from dualbrain.contracts.contract import Contract
from dualbrain.core.storage.resumable_steps import exclusive_folder, run_steps
from dualbrain.core.text import storable_text
from dualbrain.evaluation.runner.run_ledgers import MAX_DELTA
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.records import Episode
from dualbrain.runtime.data_collection.rollouts import (
    EPSILON,
    LEDGER_FILE,
    ROBOT,
    draw_proposals,
    is_declined,
    memory_id_of_turn,
    run_proposal,
    run_proposals,
    turn_of_memory_id,
)
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples, scene_context_by_name
from dualbrain.runtime.planning_time import PLANNING_TIME
from dualbrain.simulation.world import contract_goals
from experiments.adaptation.free_answers import FreeAnswerModel, Sampling
from experiments.engine.experiment import Row
from experiments.planning.language import is_right, score_question

if TYPE_CHECKING:
    from dualbrain.adaptation.training.trainer import TrainingProgress

BASE = "base-135m"
N_PLACES, N_INSTRUCTIONS = 120, 120
"""Held-out places, the same for every round; instructions of a round, others in each."""
TEMPERATURE = 0.7
"""Of what a planner proposes while it gathers experience; where it is measured it answers greedily."""
EPISODES_PER_STEP = 5
"""Held-out episodes in one step."""
HELD_OUT_SEED, FIRST_SEED = 21, 100
"""Of the held-out places; of the first instructions of the first chain."""
CONFIG = AdaptConfig(
    curation=CurationConfig(rules=CleanRules(epsilon=EPSILON)),
    fit=FitConfig(steps=60, batch=4, at_once=4, save_every=20, ask_at_most=0, threads=1, keep="last"),
)
"""As `adapt_curve` fits. All steps are taken, so that what leaves a part out is fitted for as long."""
SELECTION_RULES = CONFIG.curation.rules
ABLATIONS: dict[str, tuple[CleanRules, ObjectiveConfig]] = {
    "adapted_no_entropy": (
        SELECTION_RULES,
        msgspec.structs.replace(CONFIG.objective, lambda_h=0.0, entropy_gate="none"),
    ),
    "adapted_no_kl": (SELECTION_RULES, msgspec.structs.replace(CONFIG.objective, beta=0.0)),
    "adapted_all": (msgspec.structs.replace(SELECTION_RULES, physical=False), CONFIG.objective),
    "adapted_success": (msgspec.structs.replace(SELECTION_RULES, epsilon=MAX_DELTA), CONFIG.objective),
}
"""By part of suite `ablations`: who may teach, and the objective."""
EPISODES_FILE, STEP_TIMES_FILE = "episodes.jsonl", "seconds.txt"


@dataclass(frozen=True)
class RoundChain:
    """The rounds of one `seed` in `folder`; round 0 is the base."""

    seed: int
    folder: Path

    def planner_stack(self, number: int) -> AdapterStack:
        """Who plans in round `number`: the base, or the base with the adapter that all rounds before it led to."""
        folder = self.adapter_folder(number) if number else packaged_folder(BASE)
        return load_stack(folder, paths.cache_folder())

    def adapter_folder(self, number: int) -> Path:
        """What the rounds before `number` taught, always fitted from the base; the folder with its card."""
        return self._train(number, self.folder / f"fit {number}", CONFIG.objective, SELECTION_RULES)

    def ablated_adapter_folder(self, number: int, part: str) -> Path:
        """The same, of the same flights, with a part of adaptation left out."""
        rules, objective = ABLATIONS[part]
        return self._train(number, self.folder / f"fit {number}, {part}", objective, rules)

    def _train(self, number: int, folder: Path, objective: ObjectiveConfig, rules: CleanRules) -> Path:
        with exclusive_folder(folder):
            if not (folder / "adapter" / CARD_FILE).is_file():
                own = [read_adapter_card(self.adapter_folder(earlier)).id for earlier in range(1, number)]
                if not (folder / "dataset" / DATASET_CARD).is_file():
                    data = select_training_data(
                        self.collect_rollouts(number) / LEDGER_FILE, self.correct_declines(number), rules, own
                    )
                    write_dataset(data, folder / "dataset")
                train_adapter(read_dataset(folder / "dataset"), self.seed, folder, objective, own)
        return folder / "adapter"

    def collect_rollouts(self, number: int) -> Path:
        """The folder with the ledger of everything that was proposed in the rounds before `number`."""
        last, start = number - 1, self.collect_rollouts(number - 1) if number > 1 else None
        first = last * N_INSTRUCTIONS
        stack = self.planner_stack(last)
        speaker, name = FreeAnswerModel(stack), proposal_author(stack.layers[-1].folder.name, stack)

        def propose(turn: int) -> Sample:
            question = instructions(self.seed, last)[turn - first]
            text = speaker.generate_one(question, Sampling(TEMPERATURE, [turn]))
            return with_answer(question, storable_text(text), name)

        folder = self.folder / f"proposed in round {last}"
        return run_proposals(
            folder, N_INSTRUCTIONS, propose, first_turn=first, initial_folder=start, cache=paths.cache_folder()
        )

    def correct_declines(self, number: int) -> list[str]:
        """The memories of what was asked for before round `number` and cannot be done: declines may teach there."""
        asked = [one for last in range(number) for one in instructions(self.seed, last)]
        return [memory_id_of_turn(turn) for turn, one in enumerate(asked) if is_declined(one)]

    def training_summary(self, number: int) -> Row:
        """What the adapter of round `number` was taught, and what that cost."""
        folder = self.adapter_folder(number).parent
        card, data = read_adapter_card(folder / "adapter"), read_dataset(folder / "dataset")
        return {
            "adapter": card.id,
            "base_sha256": card.base_sha256,
            "bootstrapped": card.bootstrapped,
            "sources": card.sources,
            "dataset": card.dataset,
            "proposed": data.card.memories,
            "samples": data.card.train,
            "as_said": sum(self.follows_instruction(one) for one in data.train),
            "left_out": data.card.left_out,
            "fit_s": total_step_time(folder / STEP_TIMES_FILE),
        }

    def follows_instruction(self, one: Sample) -> bool:
        """Whether what is taught does what its instruction says: nobody looks at that when it is chosen."""
        last, place = divmod(turn_of_memory_id(one.memory), N_INSTRUCTIONS)
        question = instructions(self.seed, last)[place]
        return score_answer(one.contract, question.contract, load_skill_registry(ROBOT), lambda text: True).is_right

    def measure(self, number: int) -> list[Row]:
        """The held-out episodes of the planner of round `number`; of round 0 they are the same in every chain."""
        stack = self.planner_stack(number)
        speaker, name = FreeAnswerModel(stack), proposal_author(stack.layers[-1].folder.name, stack)

        def some(step: int, here: Path) -> None:
            turns = range(step * EPISODES_PER_STEP, min(N_PLACES, (step + 1) * EPISODES_PER_STEP))
            texts = speaker.generate([held_out_places()[turn] for turn in turns])
            with (here / EPISODES_FILE).open("ab") as lines:
                for turn, text in zip(turns, texts, strict=True):
                    lines.write(msgspec.json.encode(run_held_out_episode(turn, storable_text(text), name)) + b"\n")

        last = run_steps(self.folder / f"measured in round {number}", -(-N_PLACES // EPISODES_PER_STEP), some)
        return [msgspec.json.decode(line) for line in (last / EPISODES_FILE).read_bytes().splitlines()]


# --- questions --------------------------------------------------------------------------------------------------------


def has_one_goal(question: Sample) -> bool:
    """Whether one thing is asked for, which takes two actions at most.

    Of several the base does the first, and its body calls that a success: it would teach itself to stop there.
    """
    return question.contract.count('"skill":') <= 2


@cache
def held_out_places() -> tuple[Sample, ...]:
    """Scenes and words of the held-out part, as they come, with one goal; about one in eight is to be declined."""
    drawn = generate_examples(2 * N_PLACES, "test", HELD_OUT_SEED, {ROBOT: 1.0}, exemplar_share=0.0)
    return tuple(filter(has_one_goal, drawn))[:N_PLACES]


@cache
def instructions(seed: int, number: int) -> tuple[Sample, ...]:
    """What the planner of a round is asked for in the chain of `seed`: one goal each, scenes and words of lessons."""
    drawn = draw_proposals(FIRST_SEED + 10 * seed + number, 2 * N_INSTRUCTIONS, include_declines=True)
    return tuple(filter(has_one_goal, drawn))[:N_INSTRUCTIONS]


def with_answer(question: Sample, text: str, name: str) -> Sample:
    """The question with what `name` answered."""
    return msgspec.structs.replace(question, completion=assistant_turn(text), source=name)


# --- teaching ---------------------------------------------------------------------------------------------------------


def select_training_data(
    ledger: Path, declines: Sequence[str], rules: CleanRules = SELECTION_RULES, own: Sequence[str] = ()
) -> Dataset:
    """What `rules` let in of the ledger, in which only the model that is adapted has proposed anything.

    `declines` are the right ones, `own` the ids of its adapters in the rounds before.
    """
    registry, dials = load_skill_registry(ROBOT), msgspec.structs.replace(CONFIG.curation, rules=rules)
    with LedgerReader(ledger) as reader:
        data = assemble_dataset(curate(reader, registry, dials, declines=declines), registry, dials)
    assert not has_foreign_proposals(data.card.sources, BASE, own), data.card.sources
    return data


def train_adapter(
    data: Dataset, seed: int, folder: Path, objective: ObjectiveConfig, own: Sequence[str] = ()
) -> AdapterCard:
    """Fit an adapter of the base in `folder`, or go on with the fit there; `own` are its adapters of before."""
    from dualbrain.adaptation.training.train import adapt  # noqa: PLC0415  (torch, only where something is fitted)

    fits = msgspec.structs.replace(CONFIG.fit, seed=seed)
    config = msgspec.structs.replace(CONFIG, objective=objective, fit=fits)
    with (folder / STEP_TIMES_FILE).open("a", buffering=1) as told:
        return adapt(
            data,
            config,
            find_base_model(BASE, paths.cache_folder()),
            make_gate_judge(load_skill_registry(ROBOT)),
            folder,
            cache=paths.cache_folder(),
            clock=time.monotonic,
            report=step_time_logger(told, time.monotonic),
            own_adapters=own,
        )


def step_time_logger(told: TextIO, clock: Callable[[], float]) -> Callable[[TrainingProgress], None]:
    """Writes a line for each step: its number and how long it took [s], the first one with all that comes before it."""
    last = [clock()]

    def tell(progress: TrainingProgress) -> None:
        last.append(clock())
        print(progress.step, last[-1] - last[-2], file=told)

    return tell


def total_step_time(path: Path) -> float:
    """How long a fit took [s]; a step that was taken again after a stop counts once."""
    return sum({step: float(took) for step, took in (line.split() for line in path.read_text().splitlines())}.values())


# --- measuring --------------------------------------------------------------------------------------------------------


def run_held_out_episode(turn: int, text: str, name: str) -> Row:
    """One held-out place: the answer judged, and carried out if the gate accepts it.

    "success": the answer does what was said, the robot says so, and where something was put truth agrees; where nothing
    can be done, nothing moved.
    """
    question = held_out_places()[turn]
    scored, one = score_question(question, text), with_answer(question, text, name)
    row: Row = {
        "id": question.id,
        "scene": question.scene,
        "text": text,
        "to_decline": scored["declines"],
        "compliant": bool(scored["compliant"]),
        "right": is_right(scored),
    }
    if not scene_context_by_name(question.scene).accepts(text.encode()):
        ended = no_motion_row("rejected")
    elif is_declined(one):
        ended = no_motion_row("declined")
    else:
        with tempfile.TemporaryDirectory(prefix="dualbrain-rounds-") as folder:
            flight = run_proposal(one, Path(folder) / LEDGER_FILE, turn, cache=paths.cache_folder())
        ended = outcome_row(flight)
    moved = ended["completion_s"] is not None
    return {**row, **ended, "success": not moved if row["to_decline"] else row["right"] and ended["done"]}


def no_motion_row(outcome: str) -> Row:
    """Nothing was carried out."""
    return {"outcome": outcome, "Delta": None, "frequency": None, "completion_s": None, "done": False, "violations": 0}


def outcome_row(flight: Episode) -> Row:
    """What became of a contract that was carried out; [s] from the question, with the time that any planner is given.

    "done": the robot says that it succeeded, and where it put something somewhere truth agrees.
    """
    outcome, judgement = flight.outcome, flight.judgement
    if flight.contract is None:
        return no_motion_row(outcome.kind)
    puts = contract_goals(msgspec.convert(flight.contract, Contract)) is not None
    truth = not puts or bool(judgement and judgement.success)
    return {
        "outcome": outcome.kind,
        "Delta": outcome.Delta,
        "frequency": outcome.intervention_frequency,
        "completion_s": PLANNING_TIME + outcome.duration,
        "done": outcome.kind == "succeeded" and truth,
        "violations": len(judgement.violations) if judgement else 0,
    }
