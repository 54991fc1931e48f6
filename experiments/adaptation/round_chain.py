"""One chain of rounds: the planner proposes, the proposals are executed, and the good ones train the next adapter.

The adapter of a round plans in the next one; no other planner proposes anything. The chain has its own folder and does
every step once: after any interruption, it continues where it was.
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
from dualbrain.contracts.contract import Contract
from dualbrain.core import paths
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
from dualbrain.runtime.planning.planning_time import PLANNING_TIME
from experiments.adaptation.free_answers import FreeAnswerModel, Sampling
from experiments.engine.experiment import Row
from experiments.planning.language import is_right, score_question

if TYPE_CHECKING:
    from dualbrain.adaptation.training.trainer import TrainingProgress

BASE = "base-135m"
N_PLACES, N_INSTRUCTIONS = 120, 120
"""Number of held-out requests, the same in every round; number of instructions per round, different in each."""
TEMPERATURE = 0.7
"""Temperature of the proposals for training; measurements are greedy."""
EPISODES_PER_STEP = 5
"""Held-out episodes in one resumable step."""
HELD_OUT_SEED, FIRST_SEED = 21, 100
"""Seed of the held-out requests, and of the first instructions of the first chain."""
CONFIG = AdaptConfig(
    curation=CurationConfig(rules=CleanRules(epsilon=EPSILON)),
    fit=FitConfig(steps=60, batch=4, at_once=4, save_every=20, ask_at_most=0, threads=1, keep="last"),
)
"""The training of `ablation_curve`. All steps are taken, so that ablations are trained for as long."""
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
"""By planner role of suite `ablations`: the rules that select training samples, and the objective."""
EPISODES_FILE, STEP_TIMES_FILE = "episodes.jsonl", "seconds.txt"


@dataclass(frozen=True)
class RoundChain:
    """The rounds of one `seed` in `folder`; round 0 is the base."""

    seed: int
    folder: Path

    def planner_stack(self, number: int) -> AdapterStack:
        """The planner of round `number`: the base, or the base with the adapter trained on all earlier rounds."""
        folder = self.adapter_folder(number) if number else packaged_folder(BASE)
        return load_stack(folder, paths.cache_folder())

    def adapter_folder(self, number: int) -> Path:
        """The folder of the adapter trained, from the base, on all rounds before `number`."""
        return self._train(number, self.folder / f"fit {number}", CONFIG.objective, SELECTION_RULES)

    def ablated_adapter_folder(self, number: int, part: str) -> Path:
        """The folder of the adapter trained on the same episodes without a part of adaptation."""
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
        """The folder with the ledger of all proposals of the rounds before `number`."""
        last, start = number - 1, self.collect_rollouts(number - 1) if number > 1 else None
        first = last * N_INSTRUCTIONS
        stack = self.planner_stack(last)
        model, name = FreeAnswerModel(stack), proposal_author(stack.layers[-1].folder.name, stack)

        def propose(turn: int) -> Sample:
            question = instructions(self.seed, last)[turn - first]
            text = model.generate_one(question, Sampling(TEMPERATURE, [turn]))
            return with_answer(question, storable_text(text), name)

        folder = self.folder / f"proposed in round {last}"
        return run_proposals(
            folder, N_INSTRUCTIONS, propose, first_turn=first, initial_folder=start, cache=paths.cache_folder()
        )

    def correct_declines(self, number: int) -> list[str]:
        """The memories of infeasible requests before round `number`, whose declines may become training samples."""
        requests = [one for last in range(number) for one in instructions(self.seed, last)]
        return [memory_id_of_turn(turn) for turn, one in enumerate(requests) if is_declined(one)]

    def training_summary(self, number: int) -> Row:
        """The training data of the adapter of round `number`, and its training time."""
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
        """Whether a training sample follows its instruction; the selection of samples does not check this."""
        last, place = divmod(turn_of_memory_id(one.memory), N_INSTRUCTIONS)
        question = instructions(self.seed, last)[place]
        return score_answer(one.contract, question.contract, load_skill_registry(ROBOT), lambda text: True).is_right

    def measure(self, number: int) -> list[Row]:
        """The held-out episodes of the planner of round `number`; those of round 0 are the same in every chain."""
        stack = self.planner_stack(number)
        model, name = FreeAnswerModel(stack), proposal_author(stack.layers[-1].folder.name, stack)

        def run_episodes(step: int, folder: Path) -> None:
            turns = range(step * EPISODES_PER_STEP, min(N_PLACES, (step + 1) * EPISODES_PER_STEP))
            texts = model.generate([held_out_places()[turn] for turn in turns])
            with (folder / EPISODES_FILE).open("ab") as lines:
                for turn, text in zip(turns, texts, strict=True):
                    lines.write(msgspec.json.encode(run_held_out_episode(turn, storable_text(text), name)) + b"\n")

        n_steps = -(-N_PLACES // EPISODES_PER_STEP)
        last = run_steps(self.folder / f"measured in round {number}", n_steps, run_episodes)
        return [msgspec.json.decode(line) for line in (last / EPISODES_FILE).read_bytes().splitlines()]


# --- requests ---------------------------------------------------------------------------------------------------------


def has_one_goal(question: Sample) -> bool:
    """Whether a request has one goal, which takes at most two actions.

    For several goals the base pursues only the first, which the robot counts as a success: it would learn to stop.
    """
    return question.contract.count('"skill":') <= 2


@cache
def held_out_places() -> tuple[Sample, ...]:
    """Requests with one goal from the held-out split; about one in eight must be declined."""
    drawn = generate_examples(2 * N_PLACES, "test", HELD_OUT_SEED, {ROBOT: 1.0}, exemplar_share=0.0)
    return tuple(filter(has_one_goal, drawn))[:N_PLACES]


@cache
def instructions(seed: int, number: int) -> tuple[Sample, ...]:
    """The requests of round `number` in the chain of `seed`: one goal each, from the training split."""
    drawn = draw_proposals(FIRST_SEED + 10 * seed + number, 2 * N_INSTRUCTIONS, include_declines=True)
    return tuple(filter(has_one_goal, drawn))[:N_INSTRUCTIONS]


def with_answer(question: Sample, text: str, name: str) -> Sample:
    """The request with the answer `text` of the model `name`."""
    return msgspec.structs.replace(question, completion=assistant_turn(text), source=name)


# --- training ---------------------------------------------------------------------------------------------------------


def select_training_data(
    ledger: Path, declines: Sequence[str], rules: CleanRules = SELECTION_RULES, own: Sequence[str] = ()
) -> Dataset:
    """The data set that `rules` select from the ledger, in which only the adapted model has proposed contracts.

    `declines` are the memories of correct declines, `own` the ids of the model's adapters in earlier rounds.
    """
    registry, config = load_skill_registry(ROBOT), msgspec.structs.replace(CONFIG.curation, rules=rules)
    with LedgerReader(ledger) as reader:
        data = assemble_dataset(curate(reader, registry, config, declines=declines), registry, config)
    assert not has_foreign_proposals(data.card.sources, BASE, own), data.card.sources
    return data


def train_adapter(
    data: Dataset, seed: int, folder: Path, objective: ObjectiveConfig, own: Sequence[str] = ()
) -> AdapterCard:
    """Train an adapter of the base in `folder`, or continue its training; `own` are the model's earlier adapters."""
    from dualbrain.adaptation.training.train import adapt  # noqa: PLC0415  (imports torch)

    fit = msgspec.structs.replace(CONFIG.fit, seed=seed)
    config = msgspec.structs.replace(CONFIG, objective=objective, fit=fit)
    with (folder / STEP_TIMES_FILE).open("a", buffering=1) as log:
        return adapt(
            data,
            config,
            find_base_model(BASE, paths.cache_folder()),
            make_gate_judge(load_skill_registry(ROBOT)),
            folder,
            cache=paths.cache_folder(),
            clock=time.monotonic,
            report=step_time_logger(log, time.monotonic),
            own_adapters=own,
        )


def step_time_logger(log: TextIO, clock: Callable[[], float]) -> Callable[[TrainingProgress], None]:
    """Writes a line for each step: its number and its duration [s]; the first one includes the preparation."""
    last = [clock()]

    def write_step(progress: TrainingProgress) -> None:
        last.append(clock())
        print(progress.step, last[-1] - last[-2], file=log)

    return write_step


def total_step_time(path: Path) -> float:
    """Duration of a training run [s]; a step that was repeated after an interruption counts once."""
    lines = [line.split() for line in path.read_text().splitlines()]
    return sum({step: float(seconds) for step, seconds in lines}.values())


# --- measurement ------------------------------------------------------------------------------------------------------


def run_held_out_episode(turn: int, text: str, name: str) -> Row:
    """One held-out request: the answer of the model `name` is judged, and executed if the gate accepts it.

    "success": the answer is correct, the robot reports success, and ground truth agrees if an object was placed; for an
    infeasible request, nothing moved.
    """
    question = held_out_places()[turn]
    score, one = score_question(question, text), with_answer(question, text, name)
    row: Row = {
        "id": question.id,
        "scene": question.scene,
        "text": text,
        "to_decline": score["declines"],
        "compliant": bool(score["compliant"]),
        "right": is_right(score),
    }
    if not scene_context_by_name(question.scene).accepts(text.encode()):
        result = no_motion_row("rejected")
    elif is_declined(one):
        result = no_motion_row("declined")
    else:
        with tempfile.TemporaryDirectory(prefix="dualbrain-rounds-") as folder:
            episode = run_proposal(one, Path(folder) / LEDGER_FILE, turn, cache=paths.cache_folder())
        result = outcome_row(episode)
    moved = result["completion_s"] is not None
    return {**row, **result, "success": not moved if row["to_decline"] else row["right"] and result["done"]}


def no_motion_row(outcome: str) -> Row:
    """The fields of an episode in which no contract was executed."""
    return {"outcome": outcome, "Delta": None, "frequency": None, "completion_s": None, "done": False, "violations": 0}


def outcome_row(episode: Episode) -> Row:
    """The fields of an episode; times [s] include the fixed planning time of every planner.

    "done": the robot reports success, and ground truth agrees where it can judge; it must judge a placement.
    """
    outcome, judgement = episode.outcome, episode.judgement
    if episode.contract is None:
        return no_motion_row(outcome.kind)
    contract = msgspec.convert(episode.contract, Contract)
    places = any(action.skill == "place" for action in contract.action_sequence)
    truth = judgement.success if judgement and judgement.judged else not places
    return {
        "outcome": outcome.kind,
        "Delta": outcome.Delta,
        "frequency": outcome.intervention_frequency,
        "completion_s": PLANNING_TIME + outcome.duration,
        "done": outcome.kind == "succeeded" and truth,
        "violations": len(judgement.violations) if judgement else 0,
    }
