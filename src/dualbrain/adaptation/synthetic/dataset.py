"""Synthetic examples as a data set, and the judge of answers during training on it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import msgspec

from dualbrain.adaptation.compliance import AnswerJudge
from dualbrain.adaptation.config import AdaptConfig, FitConfig, ObjectiveConfig
from dualbrain.adaptation.curation.dataset import Dataset, DatasetCard, card_differences, dataset_hash
from dualbrain.adaptation.curation.sample import Sample, encode_samples
from dualbrain.adaptation.synthetic.scoring import score_answer
from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.verdict import Accepted
from dualbrain.planner.prompt.short_prompt import short_template_hash

SAMPLE_FORMAT = (
    "conversational prompt-completion, JSON lines; templates with random valid parameters, nothing was carried out"
)
SYNTHETIC_ADAPT_CONFIG = AdaptConfig(
    objective=ObjectiveConfig(lambda_w=0.0, lambda_h=0.0, beta=0.0, entropy_gate="none"),
    fit=FitConfig(steps=600, batch=4, at_once=2, save_every=25, ask_at_most=0, patience=9, threads=2),
)
"""Plain supervised fine-tuning: synthetic examples have no memory weights, and the KL term has nothing to preserve."""
N_TRAIN_EXAMPLES, N_CHECK_EXAMPLES = 2400, 20
"""One epoch of these settings. The held-out part is evaluated by its loss only, because generating answers takes as
long as twenty steps."""


def build_synthetic_dataset(
    train: Sequence[Sample], held_out: Sequence[Sample], registries: Mapping[str, SkillRegistry]
) -> Dataset:
    """The data set with training part `train` and held-out part `held_out`.

    The robot of its card is the first of `registries`; the others are in `also`.
    """
    hashes = {name: registry.hash for name, registry in registries.items()}
    first = next(iter(hashes))
    rows = (*train, *held_out)
    card = DatasetCard(
        hash=dataset_hash(encode_samples(tuple(train)), encode_samples(tuple(held_out))),
        form=SAMPLE_FORMAT,
        robot=first,
        registry=hashes.pop(first),
        prompt=short_template_hash(),
        ledger="",
        event=0,
        memories=0,
        train=len(train),
        held_out=len(held_out),
        shown=sum(row.repeats for row in train),
        scenes=len({row.scene for row in rows}),
        merged=0,
        left_out={},
        sources=dict(Counter(row.source for row in rows)),
        epsilon=0.0,
        slowest=0.0,
        most_repeats=1,
        share_held_out=len(held_out) / len(rows),
        salt="",
        also=hashes,
    )
    return Dataset(card, tuple(train), tuple(held_out))


def synthetic_dataset_differences(card: DatasetCard, registries: Mapping[str, SkillRegistry]) -> str:
    """How the data set of `card` differs from a synthetic one for `registries`, in words; "" if it does not."""
    hashes = {name: registry.hash for name, registry in registries.items()}
    first = next(iter(hashes))
    expected = {"form": SAMPLE_FORMAT, "robot": first, "registry": hashes.pop(first), "also": hashes}
    return card_differences(card, expected | {"train": N_TRAIN_EXAMPLES, "held_out": N_CHECK_EXAMPLES})


def make_language_judge(registries: Mapping[str, SkillRegistry]) -> AnswerJudge:
    """A judge that accepts what the gate of the sample's robot accepts, and a decline only where the sample declines.

    The rules on geometry and robot are not checked, as in `make_gate_judge`; no example violates them.
    """
    gates = {name: Gate(registry, {"planner": frozenset(registry.by_name)}) for name, registry in registries.items()}

    def is_valid(text: str, sample: Sample) -> bool:
        robot = msgspec.json.decode(sample.contract, type=Contract).context.robot

        def accepts(data: bytes) -> bool:
            verdict = gates[robot].check(data, names=sample.scene_names, principal="planner", now=0.0)
            return isinstance(verdict, Accepted)

        return score_answer(text, sample.contract, registries[robot], accepts).compliant

    return is_valid
