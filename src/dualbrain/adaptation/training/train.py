"""Training from a data set to an adapter in one folder; an interrupted run resumes from its checkpoint."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable, Collection
from importlib import metadata
from pathlib import Path

import msgspec

from dualbrain.adaptation.adapters.base_models import BaseModel
from dualbrain.adaptation.adapters.card import AdapterCard, has_foreign_proposals, hash_weights, write_adapter_card
from dualbrain.adaptation.compliance import AnswerJudge
from dualbrain.adaptation.config import AdaptConfig
from dualbrain.adaptation.curation.dataset import Dataset, DatasetCard
from dualbrain.adaptation.early_stopping import HeldOutResult
from dualbrain.adaptation.training.model.base_model import load_base_model
from dualbrain.adaptation.training.model.lora_model import LoraModel
from dualbrain.adaptation.training.model.precision import choose_dtype, configure_device
from dualbrain.adaptation.training.model.save_adapter import save_adapter
from dualbrain.adaptation.training.process_group import SINGLE_PROCESS, ProcessGroup
from dualbrain.adaptation.training.trainer import Trainer, TrainingProgress
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import create_private_folder

ADAPTER_FOLDER, CONFIG_FILE = "adapter", "config.json"


def adapt(
    dataset: Dataset,
    config: AdaptConfig,
    base: BaseModel,
    judge: AnswerJudge,
    folder: Path,
    *,
    cache: Path,
    clock: Callable[[], float],
    report: Callable[[TrainingProgress], None],
    process_group: ProcessGroup = SINGLE_PROCESS,
    own_adapters: Collection[str] = (),
) -> AdapterCard:
    """Train an adapter in `folder`, or resume the run there, and write it with its card to `folder`/adapter.

    Every process of `process_group` calls this with the same arguments; the first one writes, and all return the card.
    `clock` [s] is used for the remaining time only, and `report` receives the progress after each step. `own_adapters`
    are the ids of adapters trained only on proposals of `base`: their proposals count as its own.

    Raises `ConfigurationError`, `TrainingDivergedError` or `FileWriteError`; then no adapter is written, and calling it
    again resumes the run.
    """
    device = configure_device(config.fit.threads or 1)
    process_group.run_on_first(lambda: create_private_folder(folder))
    nf4 = config.fit.quantise == "nf4"
    model, tokenizer = load_base_model(base, cache, choose_dtype(config.fit.precision), device, nf4=nf4)
    lora_model = LoraModel(model, tokenizer, config.fit)
    trainer = Trainer(
        lora_model, dataset, config, judge, folder, base=base.sha256, clock=clock, process_group=process_group
    )
    process_group.run_on_first(lambda: _write_config(config, folder))
    result = trainer.run(report)
    is_bootstrapped = has_foreign_proposals(dataset.card.sources, base.name, own_adapters)
    return process_group.run_on_first(
        lambda: _write_result(lora_model, dataset.card, config, base, folder, trainer.step, result, is_bootstrapped)
    )


def _write_config(config: AdaptConfig, folder: Path) -> None:
    """Write the settings beside the result."""
    write_atomically(folder / CONFIG_FILE, msgspec.json.format(msgspec.json.encode(config), indent=2))


def _write_result(
    lora_model: LoraModel,
    dataset_card: DatasetCard,
    config: AdaptConfig,
    base: BaseModel,
    folder: Path,
    steps: int,
    held_out: HeldOutResult | None,
    bootstrapped: bool,
) -> AdapterCard:
    """Write the adapter of `lora_model` with its card."""
    packages = ("torch", "transformers", "peft", *(("bitsandbytes",) if config.fit.quantise == "nf4" else ()))
    save_adapter(lora_model, folder / ADAPTER_FOLDER, base=base.sha256)
    card = AdapterCard(
        id=hash_weights(folder / ADAPTER_FOLDER),
        base=base.name,
        base_sha256=base.sha256,
        robot=dataset_card.robot,
        registry=dataset_card.registry,
        prompt=dataset_card.prompt,
        dataset=dataset_card.hash,
        sources=dataset_card.sources,
        bootstrapped=bootstrapped,
        precision=str(lora_model.head.dtype).removeprefix("torch."),
        steps=steps,
        held_out=held_out,
        config=config,
        versions={name: metadata.version(name) for name in packages},
        also=dataset_card.also,
        scene_values=dataset_card.scene_values,
    )
    write_adapter_card(card, folder / ADAPTER_FOLDER)
    return card
