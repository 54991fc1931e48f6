"""Adapters with different settings, fitted side by side.

    python -m experiments.adaptation.exploration.parallel_fits PLAN OUT

PLAN is a JSON file with a list of fits. A GPU fits several small adapters in the time of one, because one of them does
not use it fully. A finished fit is not repeated; an interrupted one continues.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
import torch
from safetensors.torch import load

from dualbrain.adaptation.adapters.base_models import find_base_model
from dualbrain.adaptation.adapters.card import CARD_FILE, WEIGHTS_FILE
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.curation.dataset import Dataset, dataset_hash, read_dataset
from dualbrain.adaptation.curation.sample import Sample, encode_samples
from dualbrain.adaptation.training.model.base_model import load_base_model
from dualbrain.adaptation.training.model.batching import tokenize_prompt
from dualbrain.adaptation.training.model.lora_model import LoraModel
from dualbrain.adaptation.training.model.precision import choose_dtype, configure_device
from dualbrain.adaptation.training.train import ADAPTER_FOLDER, adapt
from dualbrain.adaptation.training.trainer import TrainingProgress
from dualbrain.core.paths import cache_folder
from dualbrain.core.storage.atomic_files import write_atomically

LOSSES_FILE, ANSWERS_FILE = "losses.jsonl", "answers.jsonl"
MAX_ANSWER_TOKENS, ANSWERS_AT_ONCE = 320, 64
"""Longest answer [tokens], and number of questions that are answered side by side."""


class FitPlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One fit: its `name`, the folder of its data set, the first `samples` of it (0: all), base and settings.

    Afterwards the held-out samples of the data set `questions` are answered greedily, without constraints. Without
    `data` nothing is fitted, and the base answers.
    """

    name: str
    data: str = ""
    base: str = "base-135m"
    samples: int = 0
    questions: str = ""
    config: AdaptConfig = AdaptConfig()


class Answer(msgspec.Struct, frozen=True):
    """The answer to the question with this sample id."""

    id: str
    text: str


def main() -> int:
    """Fit all adapters of a plan."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plan", type=Path, help="JSON file: a list of fits")
    parser.add_argument("out", type=Path, help="folder with one folder per fit")
    parser.add_argument("--processes", type=int, default=1, help="fits at the same time")
    options = parser.parse_args()
    plans = msgspec.json.decode(options.plan.read_bytes(), type=list[FitPlan])
    options.out.mkdir(parents=True, exist_ok=True)
    for base in {plan.base for plan in plans}:  # converted once, not in every process
        load_base_model(find_base_model(base, cache_folder()), cache_folder(), torch.float32, torch.device("cpu"))
    jobs = [(plan, options.plan.parent, options.out) for plan in plans]
    with multiprocessing.get_context("spawn").Pool(options.processes, maxtasksperchild=1) as pool:
        for name, seconds in pool.imap_unordered(_run_plan, jobs):
            print(f"{name}: {seconds:.0f} s", flush=True)
    return 0


def _run_plan(job: tuple[FitPlan, Path, Path]) -> tuple[str, float]:
    """Fit one adapter and answer its questions; returns its name and the time [s]."""
    plan, root, out = job
    folder, start = out / plan.name, time.monotonic()
    if plan.data and not (folder / ADAPTER_FOLDER / CARD_FILE).is_file():
        _fit(plan, first_samples(read_dataset(root / plan.data), plan.samples), folder)
    if plan.questions and not (folder / ANSWERS_FILE).is_file():
        folder.mkdir(parents=True, exist_ok=True)
        answers = _answer(plan, read_dataset(root / plan.questions).held_out, folder)
        write_atomically(folder / ANSWERS_FILE, b"".join(msgspec.json.encode(one) + b"\n" for one in answers))
    return plan.name, time.monotonic() - start


def _fit(plan: FitPlan, dataset: Dataset, folder: Path) -> None:
    """Fit the adapter of `plan` in `folder`, with the losses of its steps."""
    losses: list[bytes] = []

    def report(progress: TrainingProgress) -> None:
        losses.append(msgspec.json.encode([progress.step, progress.cross_entropy, progress.divergence]) + b"\n")
        if progress.held_out is not None or progress.step == progress.steps:
            write_atomically(folder / LOSSES_FILE, b"".join(losses))

    adapt(
        dataset,
        plan.config,
        find_base_model(plan.base, cache_folder()),
        lambda text, sample: False,  # no question is asked during training
        folder,
        cache=cache_folder(),
        clock=time.monotonic,
        report=report,
    )


def _answer(plan: FitPlan, questions: Sequence[Sample], folder: Path) -> list[Answer]:
    """The greedy answers of the adapter in `folder`, or of the base, without constraints."""
    device, cache = configure_device(plan.config.fit.threads or 1), cache_folder()
    dtype = choose_dtype(plan.config.fit.precision)
    model, tokenizer = load_base_model(find_base_model(plan.base, cache), cache, dtype, device)
    lora_model = LoraModel(model, tokenizer, plan.config.fit)
    if plan.data:
        weights = load((folder / ADAPTER_FOLDER / WEIGHTS_FILE).read_bytes())
        lora_model.load_adapter({name: tensor.to(device) for name, tensor in weights.items()})
    found: list[Answer] = []
    for start in range(0, len(questions), ANSWERS_AT_ONCE):
        some = questions[start : start + ANSWERS_AT_ONCE]
        prompts = [tokenize_prompt(tokenizer, one.prompt) for one in some]
        texts = lora_model.generate_answers(prompts, MAX_ANSWER_TOKENS)
        found += [Answer(one.id, text) for one, text in zip(some, texts, strict=True)]
    return found


def first_samples(dataset: Dataset, count: int) -> Dataset:
    """`dataset` with the first `count` training samples (0: all of them) and a card for them."""
    if not count or count >= len(dataset.train):
        return dataset
    return with_training_samples(dataset, dataset.train[:count])


def with_training_samples(dataset: Dataset, train: tuple[Sample, ...]) -> Dataset:
    """`dataset` with the training samples `train`, and a card for them."""
    card = msgspec.structs.replace(
        dataset.card,
        hash=dataset_hash(encode_samples(train), encode_samples(dataset.held_out)),
        train=len(train),
        shown=sum(row.repeats for row in train),
        scenes=len({row.scene for row in (*train, *dataset.held_out)}),
    )
    return Dataset(card, train, dataset.held_out)


if __name__ == "__main__":
    raise SystemExit(main())
