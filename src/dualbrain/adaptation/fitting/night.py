"""The whole way from a data set to an adapter in one folder, which can be taken up again where it was left."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import msgspec
import torch

from dualbrain.adaptation.adapter_card import AdapterCard, proposed_by_others, weights_id, write_card
from dualbrain.adaptation.bases import Base
from dualbrain.adaptation.compliance import Judge
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.dataset import Dataset
from dualbrain.adaptation.durable import write_durably
from dualbrain.adaptation.fitting.adapter_folder import write_adapter
from dualbrain.adaptation.fitting.base_model import open_base
from dualbrain.adaptation.fitting.learner import Learner
from dualbrain.adaptation.fitting.loop import Fit, Progress
from dualbrain.adaptation.fitting.precision import choose
from dualbrain.adaptation.fitting.taught import prepare

ADAPTER, STATES, RESOLVED = "adapter", "base_states.safetensors", "config.json"


def adapt(
    dataset: Dataset, config: AdaptConfig, base: Base, judge: Judge, folder: Path, *, cache: Path,
    clock: Callable[[], float], tell: Callable[[Progress], None],
) -> AdapterCard:  # fmt: skip
    """Fit an adapter in `folder`, or go on with the one there, and write it with its card to `folder`/adapter.

    Raises `InvalidSetup`, `Diverged`, `DiskFull`; then no adapter is written, and calling it again goes on.
    """
    torch.set_num_threads(config.fit.threads or 1)
    torch.use_deterministic_algorithms(mode=True)
    dtype = choose(config.fit.precision)
    model, tokenizer = open_base(base, cache, dtype)
    learner = Learner(model, tokenizer, config.fit)
    folder.mkdir(parents=True, exist_ok=True)
    write_durably(folder / RESOLVED, msgspec.json.format(msgspec.json.encode(config), indent=2))
    taught = prepare(learner, dataset, config.objective, base.sha256, folder / STATES)
    fit = Fit(learner, taught, dataset, config, judge, folder, base=base.sha256, clock=clock)
    found = fit.run(tell)
    write_adapter(learner, folder / ADAPTER, base=base.sha256)
    told = dataset.card
    card = AdapterCard(
        weights_id(folder / ADAPTER), base.name, base.sha256, told.robot, told.registry, told.prompt, told.hash,
        told.sources, proposed_by_others(told.sources, base.name), str(dtype).removeprefix("torch."), fit.step, found,
        config, {name: metadata.version(name) for name in ("torch", "transformers", "peft")}, told.also,
    )  # fmt: skip
    write_card(card, folder / ADAPTER)
    return card
