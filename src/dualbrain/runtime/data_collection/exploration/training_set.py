"""The training set of an adaptation: clean contracts in several wordings, and a share of rehearsal examples.

Only contracts that were executed in the full simulation and curated from its ledger are D_clean (paper 6.1);
`clean_from_trials` takes executions of the twin instead, for learning curves, and marks them with their own source. The
weight ŵ of a sample (paper 6.2) is the probability that its contract beats the mean of its siblings, by the value
model: places at which the choice matters count more.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import msgspec
import numpy as np

from dualbrain.adaptation.curation.curate import CONTRACT_ID, CurationConfig, content_id, curate
from dualbrain.adaptation.curation.dataset import SAMPLE_FORMAT, Dataset, DatasetCard, dataset_hash
from dualbrain.adaptation.curation.sample import Sample, encode_samples
from dualbrain.adaptation.synthetic.split import TRAINING_PART
from dualbrain.adaptation.value_model.value_model import ValueModel
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.errors import ConfigurationError
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.planner.prompt.short_prompt import (
    MAX_SHOWN_EXEMPLARS,
    exemplar_steps,
    render_short_with_steps,
    short_template_hash,
)
from dualbrain.runtime.data_collection.exploration.corruption import corrupt
from dualbrain.runtime.data_collection.exploration.place import Place
from dualbrain.runtime.data_collection.exploration.proposals import draw_sentence, make_sample
from dualbrain.runtime.data_collection.exploration.rehearsal import draw_rehearsal
from dualbrain.runtime.data_collection.exploration.trial import Trial
from dualbrain.runtime.data_collection.rollouts import LEDGER_FILE, load_proposals, turn_of_memory_id

TWIN_SOURCE = "value-model, twin only"
"""The source of samples whose contract was executed in the twin alone."""


class CleanContract(msgspec.Struct, frozen=True, kw_only=True):
    """A clean contract at one place, with its evidence: memory and ledger events, none for the twin."""

    scene: str
    object_name: str
    destination: str
    contract: str
    weight: float
    Delta: float
    duration: float
    source: str
    memory: str = ""
    events: tuple[int, ...] = ()

    @property
    def place(self) -> Place:
        """The place of the contract."""
        return Place(
            self.scene, (("grasp", {"object": self.object_name}), ("place", {"destination": self.destination}))
        )


class TrainingSetConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Composition of a training set.

    `wordings` is the number of sentences for each clean contract, `rehearsal` the share of rehearsal examples in all
    samples, `exemplars` the share of placements with exemplars in the prompt, `corrupted` the share of those without
    exemplars whose prompt is corrupted (`corruption.py`); `seed` determines all draws. Sentences and scenes are those
    of the part of the split for training.
    """

    wordings: int = 5
    rehearsal: float = 0.3
    exemplars: float = 0.3
    corrupted: float = 0.1
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for a number of wordings below 1 and for shares outside their ranges."""
        if self.wordings < 1:
            raise ConfigurationError("training set wordings", got=self.wordings, allowed="at least 1")
        if not 0.0 <= self.rehearsal < 1.0:
            raise ConfigurationError("training set rehearsal", got=self.rehearsal, allowed="at least 0, below 1")
        for name in ("exemplars", "corrupted"):
            if not 0.0 <= (got := getattr(self, name)) <= 1.0:
                raise ConfigurationError(f"training set {name}", got=got, allowed="0 to 1")


DEFAULT_CONFIG = TrainingSetConfig()


def clean_from_ledger(folder: Path, config: CurationConfig, value_model: ValueModel) -> tuple[CleanContract, ...]:
    """D_clean of a folder of `run_proposals`; raises as `curate` does."""
    proposals = load_proposals(folder)
    robot = proposals[0].scene.partition(" ")[0]
    with LedgerReader(folder / LEDGER_FILE) as ledger:
        curated = curate(ledger, load_skill_registry(robot), config)
    found: list[CleanContract] = []
    for one in sorted((*curated.train, *curated.held_out), key=lambda one: turn_of_memory_id(one.memory)):
        proposal = proposals[turn_of_memory_id(one.memory)]
        obj, destination = _names(proposal.contract)
        found.append(
            CleanContract(
                scene=proposal.scene,
                object_name=obj,
                destination=destination,
                contract=proposal.contract,
                weight=probability_of_advantage(value_model, proposal.scene, proposal.contract),
                Delta=one.Delta,
                duration=one.duration,
                source=one.source,
                memory=one.memory,
                events=one.events,
            )
        )
    return tuple(found)


def clean_from_trials(trials: Iterable[Trial], epsilon: float, value_model: ValueModel) -> tuple[CleanContract, ...]:
    """The trials of the twin that succeeded with Δ ≤ `epsilon`."""
    return tuple(
        CleanContract(
            scene=one.scene,
            object_name=one.object_name,
            destination=one.destination,
            contract=one.contract,
            weight=probability_of_advantage(value_model, one.scene, one.contract),
            Delta=one.Delta or 0.0,
            duration=one.duration,
            source=TWIN_SOURCE,
        )
        for one in trials
        if one.kind == "succeeded" and (one.Delta or 0.0) <= epsilon
    )


def probability_of_advantage(value_model: ValueModel, scene: str, contract: str) -> float:
    """ŵ = Φ(a / √(s² + σ²)) for the predicted advantage a with standard deviation s and residual variance σ².

    A contract that is none of the alternatives has ½.
    """
    obj, destination = _names(contract)
    place = Place(scene, (("grasp", {"object": obj}), ("place", {"destination": destination})))
    name = next((name for name, text in place.contracts().items() if text == contract), "")
    ranked = value_model.rank(place.placement, [name])
    if not ranked:
        return 0.5
    spread = math.sqrt(ranked[0].deviation ** 2 + value_model.variance)
    return 0.5 * (1.0 + math.erf(ranked[0].advantage / (spread * math.sqrt(2.0)))) if spread else 0.5


def build_training_set(
    clean: Sequence[CleanContract],
    robot: str,
    config: TrainingSetConfig = DEFAULT_CONFIG,
    *,
    on_sample: Callable[[int], None] = lambda done: None,
) -> tuple[Sample, ...]:
    """`wordings` samples of each of the `clean` contracts, and rehearsal examples, in a random order by the seed."""
    samples: list[Sample] = []
    for index, one in enumerate(clean):
        samples += _placement_samples(one, clean, index, config)
        on_sample(len(samples))
    n_rehearsal = round(len(samples) * config.rehearsal / (1.0 - config.rehearsal))
    for index in range(n_rehearsal):
        samples.append(draw_rehearsal(robot, TRAINING_PART, config.seed, index))
        on_sample(len(samples))
    unique = list({one.id: one for one in samples}.values())
    order = np.random.default_rng([config.seed, 3]).permutation(len(unique))
    return tuple(unique[int(i)] for i in order)


def assemble_training_set(
    train: Sequence[Sample], held_out: Sequence[Sample], registry: SkillRegistry, curation: CurationConfig
) -> Dataset:
    """The data set of both parts, whose prompts state fitting values; `curation` selected the clean contracts."""
    rows = (*train, *held_out)
    card = DatasetCard(
        hash=dataset_hash(encode_samples(tuple(train)), encode_samples(tuple(held_out))),
        form=SAMPLE_FORMAT,
        robot=registry.robot,
        registry=registry.hash,
        prompt=short_template_hash(),
        ledger="",
        event=max((event for row in rows for event in row.events), default=0),
        memories=len({row.memory for row in rows if row.memory}),
        train=len(train),
        held_out=len(held_out),
        shown=sum(row.repeats for row in train),
        scenes=len({row.scene for row in rows}),
        merged=0,
        left_out={},
        sources=dict(sorted(Counter(row.source for row in rows).items())),
        epsilon=curation.rules.epsilon,
        slowest=curation.rules.slowest,
        most_repeats=1,
        share_held_out=len(held_out) / len(rows),
        salt=curation.salt,
        physical=curation.rules.physical,
        scene_values=True,
    )
    return Dataset(card, tuple(train), tuple(held_out))


def _placement_samples(
    one: CleanContract, pool: Sequence[CleanContract], index: int, config: TrainingSetConfig
) -> list[Sample]:
    """The samples of one clean contract: `wordings` different sentences, some of them with exemplars of the pool."""
    rng, place = np.random.default_rng([config.seed, index, 4]), one.place
    sentences: list[str] = []
    for _ in range(4 * config.wordings):
        sentence = draw_sentence(place, TRAINING_PART, rng)
        if sentence not in sentences and len(sentences) < config.wordings:
            sentences.append(sentence)
    found: list[Sample] = []
    for sentence in sentences:
        sample = make_sample(place, one.contract, sentence, source=one.source)
        if rng.random() < config.exemplars and len(pool) > MAX_SHOWN_EXEMPLARS:
            sample = _with_exemplars(sample, place, sentence, _other_contracts(pool, index, rng))
        elif rng.random() < config.corrupted:
            scene, words = corrupt(place.summary, sentence, (one.object_name, one.destination), rng)
            sample = _with_prompt(sample, place, scene, words, [])
        found.append(
            msgspec.structs.replace(
                sample,
                weight=one.weight,
                Delta=one.Delta,
                duration=one.duration,
                memory=one.memory,
                events=one.events,
            )
        )
    return found


def _other_contracts(pool: Sequence[CleanContract], index: int, rng: np.random.Generator) -> list[str]:
    """One to three clean contracts of other places, as a memory would show them."""
    others = rng.choice(len(pool), size=int(rng.integers(1, MAX_SHOWN_EXEMPLARS + 1)), replace=False)
    return [pool[int(i)].contract for i in others if int(i) != index]


def _with_exemplars(sample: Sample, place: Place, sentence: str, contracts: Sequence[str]) -> Sample:
    """`sample` with the steps of `contracts` before the scene; its answer keeps the values of its own scene."""
    steps = [exemplar_steps(msgspec.json.decode(text)) for text in contracts]
    return _with_prompt(sample, place, place.summary, sentence, steps)


def _with_prompt(sample: Sample, place: Place, scene: str, sentence: str, steps: list[str]) -> Sample:
    """`sample` with another prompt and the same answer."""
    registry = place.registry
    prompt = render_short_with_steps(
        steps, scene, sentence, robot=registry.robot, registry=registry.hash, contract_id=CONTRACT_ID
    )
    messages = [{"role": turn["role"], "content": turn["content"]} for turn in prompt]
    return msgspec.structs.replace(sample, id=content_id(messages, sample.contract), prompt=messages)


def _names(contract: str) -> tuple[str, str]:
    """The object and the destination of a placement."""
    grasp, place = msgspec.json.decode(contract)["action_sequence"]
    return str(grasp["params"]["object"]), str(place["params"]["destination"])
