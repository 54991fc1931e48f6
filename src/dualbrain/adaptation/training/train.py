"""The whole way from a data set to an adapter in one folder, which can be taken up again where it was left."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable, Collection
from importlib import metadata
from pathlib import Path

import msgspec

from dualbrain.adaptation.adapters.base_models import Base
from dualbrain.adaptation.adapters.card import AdapterCard, proposed_by_others, weights_id, write_card
from dualbrain.adaptation.compliance import Judge
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.curation.dataset import Dataset, DatasetCard
from dualbrain.adaptation.early_stopping import HeldOut
from dualbrain.adaptation.training.model.base_model import open_base
from dualbrain.adaptation.training.model.lora_model import Learner
from dualbrain.adaptation.training.model.precision import choose, settle
from dualbrain.adaptation.training.model.save_adapter import write_adapter
from dualbrain.adaptation.training.process_group import ALONE, Team
from dualbrain.adaptation.training.trainer import Fit, Progress
from dualbrain.core.storage.atomic_files import write_durably

ADAPTER, RESOLVED = "adapter", "config.json"


def adapt(
    dataset: Dataset, config: AdaptConfig, base: Base, judge: Judge, folder: Path, *, cache: Path,
    clock: Callable[[], float], tell: Callable[[Progress], None], team: Team = ALONE, own: Collection[str] = (),
) -> AdapterCard:  # fmt: skip
    """Fit an adapter in `folder`, or go on with the one there, and write it with its card to `folder`/adapter.

    Every process of `team` calls this with the same; the first one writes, and all get the card. `own` are the ids of
    adapters that `base` alone has taught: what these proposed counts as its own.
    Raises `InvalidSetup`, `Diverged`, `DiskFull`; then no adapter is written, and calling it again goes on.
    """
    device = settle(config.fit.threads or 1)
    team.once(lambda: folder.mkdir(parents=True, exist_ok=True))
    nf4 = config.fit.quantise == "nf4"
    model, tokenizer = open_base(base, cache, choose(config.fit.precision), device, nf4=nf4)
    learner = Learner(model, tokenizer, config.fit)
    fit = Fit(learner, dataset, config, judge, folder, base=base.sha256, clock=clock, team=team)
    team.once(lambda: _resolve(config, folder))
    found = fit.run(tell)
    others = proposed_by_others(dataset.card.sources, base.name, own)
    return team.once(lambda: _write(learner, dataset.card, config, base, folder, fit.step, found, others))


def _resolve(config: AdaptConfig, folder: Path) -> None:
    """Write beside the result what was asked."""
    write_durably(folder / RESOLVED, msgspec.json.format(msgspec.json.encode(config), indent=2))


def _write(
    learner: Learner, told: DatasetCard, config: AdaptConfig, base: Base, folder: Path, steps: int,
    found: HeldOut | None, bootstrapped: bool,
) -> AdapterCard:  # fmt: skip
    """The adapter that `learner` wears, with its card."""
    packages = ("torch", "transformers", "peft", *(("bitsandbytes",) if config.fit.quantise == "nf4" else ()))
    write_adapter(learner, folder / ADAPTER, base=base.sha256)
    card = AdapterCard(
        weights_id(folder / ADAPTER), base.name, base.sha256, told.robot, told.registry, told.prompt, told.hash,
        told.sources, bootstrapped, str(learner.head.dtype).removeprefix("torch."),
        steps, found, config, {name: metadata.version(name) for name in packages}, told.also,
    )  # fmt: skip
    write_card(card, folder / ADAPTER)
    return card
