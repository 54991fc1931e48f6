"""Lessons as a data set, like any other that an adapter is fitted on, and who judges the answers meanwhile."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import msgspec

from dualbrain.adaptation.compliance import Judge
from dualbrain.adaptation.config import AdaptConfig, FitDials, ObjectiveDials
from dualbrain.adaptation.curation.dataset import Dataset, DatasetCard, dataset_hash, made_otherwise
from dualbrain.adaptation.curation.sample import Sample, to_lines
from dualbrain.adaptation.synthetic.scoring import score
from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import Registry
from dualbrain.contracts.verdict import Accepted
from dualbrain.planner.prompt.short_prompt import short_template_hash

FORM = "conversational prompt-completion, JSON lines; templates with random valid parameters, nothing was carried out"
DIALS = AdaptConfig(
    objective=ObjectiveDials(lambda_w=0.0, lambda_h=0.0, beta=0.0, entropy_gate="none"),
    fit=FitDials(steps=600, batch=4, at_once=2, save_every=25, ask_at_most=0, patience=9, threads=2),
)
"""Plain fine-tuning: there is nothing to weigh in lessons, and nothing of the model's manners to keep."""
LESSONS, CHECKS = 2400, 20
"""One epoch of the dials; checked by their loss alone, for free answers take as long as twenty steps."""


def course(taught: Sequence[Sample], asked: Sequence[Sample], registries: Mapping[str, Registry]) -> Dataset:
    """The data set that teaches `taught` and asks `asked` meanwhile; its first robot is the first of `registries`."""
    hashes = {name: registry.hash for name, registry in registries.items()}
    first = next(iter(hashes))
    rows = (*taught, *asked)
    card = DatasetCard(
        dataset_hash(to_lines(tuple(taught)), to_lines(tuple(asked))), FORM, first, hashes.pop(first),
        short_template_hash(), "", 0, 0, len(taught), len(asked), sum(row.repeats for row in taught),
        len({row.scene for row in rows}), 0, {}, dict(Counter(row.source for row in rows)), 0.0, 0.0, 1,
        len(asked) / len(rows), "", also=hashes,
    )  # fmt: skip
    return Dataset(card, tuple(taught), tuple(asked))


def not_course(card: DatasetCard, registries: Mapping[str, Registry]) -> str:
    """In what the data set of `card` is another than a course of `registries`, of its length; "" if in none."""
    hashes = {name: registry.hash for name, registry in registries.items()}
    first = next(iter(hashes))
    made = {"form": FORM, "robot": first, "registry": hashes.pop(first), "also": hashes}
    return made_otherwise(card, made | {"train": LESSONS, "held_out": CHECKS})


def language_judge(registries: Mapping[str, Registry]) -> Judge:
    """Accepts what the gate of the sample's robot accepts, and a refusal exactly where the sample refuses.

    Without the rules on geometry and body, as `gate_judge`; no lesson was drawn that the whole gate refuses.
    """
    gates = {
        name: Gate(registry, {"planner": frozenset(registry.by_name)}) for name, registry in registries.items()
    }  # fmt: skip

    def sound(text: str, sample: Sample) -> bool:
        robot = msgspec.json.decode(sample.contract, type=Contract).context.robot

        def accepts(data: bytes) -> bool:
            verdict = gates[robot].check(data, names=sample.names, principal="planner", now=0.0)
            return isinstance(verdict, Accepted)

        return score(text, sample.contract, registries[robot], accepts).compliant

    return sound
