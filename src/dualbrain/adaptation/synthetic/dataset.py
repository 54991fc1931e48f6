"""Lessons as a data set, like any other that an adapter is fitted on, and who judges the answers meanwhile."""

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
"""Plain fine-tuning: there is nothing to weigh in lessons, and nothing of the model's manners to keep."""
N_TRAIN_EXAMPLES, N_CHECK_EXAMPLES = 2400, 20
"""One epoch of the dials; checked by their loss alone, for free answers take as long as twenty steps."""


def build_synthetic_dataset(
    train: Sequence[Sample], held_out: Sequence[Sample], registries: Mapping[str, SkillRegistry]
) -> Dataset:
    """The data set that teaches `taught` and asks `asked` meanwhile; its first robot is the first of `registries`."""
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
    """In what the data set of `card` is another than a course of `registries`, of its length; "" if in none."""
    hashes = {name: registry.hash for name, registry in registries.items()}
    first = next(iter(hashes))
    made = {"form": SAMPLE_FORMAT, "robot": first, "registry": hashes.pop(first), "also": hashes}
    return card_differences(card, made | {"train": N_TRAIN_EXAMPLES, "held_out": N_CHECK_EXAMPLES})


def make_language_judge(registries: Mapping[str, SkillRegistry]) -> AnswerJudge:
    """Accepts what the gate of the sample's robot accepts, and a refusal exactly where the sample refuses.

    Without the rules on geometry and body, as `gate_judge`; no lesson was drawn that the whole gate refuses.
    """
    gates = {name: Gate(registry, {"planner": frozenset(registry.by_name)}) for name, registry in registries.items()}

    def sound(text: str, sample: Sample) -> bool:
        robot = msgspec.json.decode(sample.contract, type=Contract).context.robot

        def accepts(data: bytes) -> bool:
            verdict = gates[robot].check(data, names=sample.scene_names, principal="planner", now=0.0)
            return isinstance(verdict, Accepted)

        return score_answer(text, sample.contract, registries[robot], accepts).compliant

    return sound
