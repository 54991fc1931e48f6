"""A data set with at most as many samples of each kind as a cap, so that rare choices are learned in few steps.

    python -m experiments.adaptation.exploration.balanced_samples DATA OUT COUNT

The kind of a sample is the sequence of skills, the speed and the clearance class of its first grasp, whether the object
is fragile, and whether a person is in the scene. The cap is the largest one that leaves at most COUNT samples. A small
adapter that sees each kind as often as it occurs learns the most frequent choice first, and chooses it everywhere.
"""

from __future__ import annotations

import argparse
import json
import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from dualbrain.adaptation.curation.dataset import Dataset, read_dataset, write_dataset
from dualbrain.adaptation.curation.sample import Sample
from experiments.adaptation.exploration.parallel_fits import with_training_samples

CLEARANCE_BOUNDS = (0.15, 0.28)
"""Clearances [m] that separate the classes low, middle and high."""

Kind = tuple[object, ...]


def main() -> int:
    """Write the balanced data set."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path, help="folder of the data set")
    parser.add_argument("out", type=Path, help="folder of the balanced data set")
    parser.add_argument("count", type=int, help="largest number of training samples")
    options = parser.parse_args()
    dataset = balance_dataset(read_dataset(options.data), options.count)
    write_dataset(dataset, options.out)
    for kind, samples in sorted(group_by_kind(dataset.train).items(), key=lambda item: -len(item[1])):
        print(f"{len(samples):5d}  {kind}")
    print(f"{len(dataset.train)} samples, data set {dataset.card.hash}")
    return 0


def balance_dataset(dataset: Dataset, count: int) -> Dataset:
    """`dataset` with at most `count` training samples, of each kind the first ones up to a common cap."""
    groups = group_by_kind(dataset.train)
    cap = largest_cap([len(group) for group in groups.values()], count)
    chosen = {sample.id for group in groups.values() for sample in group[:cap]}
    return with_training_samples(dataset, tuple(sample for sample in dataset.train if sample.id in chosen))


def largest_cap(sizes: Sequence[int], count: int) -> int:
    """The largest cap c with Σ min(size, c) ≤ `count`; the largest size if all samples fit."""
    fitting = [cap for cap in range(max(sizes, default=0) + 1) if sum(min(size, cap) for size in sizes) <= count]
    return fitting[-1]


def group_by_kind(samples: Sequence[Sample]) -> dict[Kind, list[Sample]]:
    """The `samples` of each kind, in their order."""
    groups: defaultdict[Kind, list[Sample]] = defaultdict(list)
    for sample in samples:
        groups[sample_kind(sample)].append(sample)
    return dict(groups)


def sample_kind(sample: Sample) -> Kind:
    """The kind of `sample`: skills, and for the first grasp speed, clearance class, fragile object, person."""
    actions = json.loads(sample.contract)["action_sequence"]
    skills = tuple(action["skill"] for action in actions)
    grasp = next((action["params"] for action in actions if action["skill"] == "grasp"), None)
    if grasp is None:
        return (skills,)
    scene = sample.prompt[-1]["content"].rpartition("<scene>")[2]
    described = re.search(rf"^{re.escape(grasp['object'])}: .*", scene, re.MULTILINE)
    fragile = described is not None and "fragile" in described.group()
    clearance = sum(grasp["clearance"] > bound for bound in CLEARANCE_BOUNDS)
    return skills, grasp["speed"], clearance, fragile, "person: none" not in scene


if __name__ == "__main__":
    raise SystemExit(main())
