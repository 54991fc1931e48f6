"""One cycle of adaptation by exploration, from an empty folder to a training set.

1. All alternatives are executed at some places, in the kinematic twin.
2. The value model is fitted to these siblings.
3. Its choices at new places are executed in the full simulation and stored in ledgers.
4. D_clean is curated from the ledgers, and the training set is built from it.

Every stage continues after an interruption and ends with the same files.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any, cast

import msgspec

from dualbrain.adaptation.config import MAX_FILE_BYTES, AdaptConfig, FitConfig, read_settings
from dualbrain.adaptation.curation.dataset import SAMPLE_FORMAT, Dataset, DatasetCard, card_differences
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.synthetic.split import TRAINING_PART, Split
from dualbrain.adaptation.value_model.value_model import (
    VALUE_MODEL_FILE,
    ValueModel,
    fit_value_model,
    load_value_model,
    save_value_model,
)
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.core.storage.resumable_steps import last_step_folder
from dualbrain.core.text import describe_differences
from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, MissingDependencyError
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.records import Episode
from dualbrain.runtime.data_collection.exploration.explore import explore
from dualbrain.runtime.data_collection.exploration.proposals import propose_best
from dualbrain.runtime.data_collection.exploration.rehearsal import draw_rehearsal
from dualbrain.runtime.data_collection.exploration.training_set import (
    CleanContract,
    TrainingSetConfig,
    assemble_training_set,
    build_training_set,
    clean_from_ledger,
)
from dualbrain.runtime.data_collection.exploration.trial import Trial, group_siblings
from dualbrain.runtime.data_collection.rollouts import run_proposals

EXPLORED_FOLDER, EXECUTED_FOLDER = "explored", "executed"
CHECK_PART: Split = "check"
"""Part of the split from which the held-out samples are drawn; their contracts are not executed."""
REHEARSED_CHECKS = 3
"""Every third held-out sample is a rehearsal example."""
SETTINGS_FILE = "cycle.json"
"""File with the settings that determine the data of a folder."""
FORMER_PART = "part"
"""Former setting of the training set in the stored settings: the part of the split from which it was drawn."""


class CycleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of one cycle for `robot`.

    `explored`: number of places of the sequence `explored_seed` at which all alternatives are executed. `executions`:
    number of places of each of the sequences `executed_seeds` at which the value model's choice is executed. Sequences
    may be executed side by side. `held_out`: number of samples for the loss during training. By default two samples are
    in one forward pass (3.5 GB in float32; eight took 13 GB).
    """

    robot: str = "panda"
    explored_seed: int = 1
    explored: int = 120
    executed_seeds: tuple[int, ...] = (2,)
    executions: int = 300
    held_out: int = 32
    training_set: TrainingSetConfig = TrainingSetConfig()
    adapt: AdaptConfig = AdaptConfig(fit=FitConfig(at_once=2))

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for numbers with which a cycle has no data."""
        for name in ("explored", "executions", "held_out"):
            if (got := getattr(self, name)) < 1:
                raise ConfigurationError(f"cycle {name}", got=got, allowed="at least 1")
        if not self.executed_seeds or len(set(self.executed_seeds)) < len(self.executed_seeds):
            raise ConfigurationError("cycle executed_seeds", got=self.executed_seeds, allowed="different numbers")


def read_cycle_config(path: Path) -> CycleConfig:
    """The settings in the TOML file at `path`; raises `ConfigurationError` for a wrong or unknown setting."""
    fix = "docs/explanation/adaptation.md describes the settings of a cycle."
    return read_settings(path, CycleConfig, "The settings of the cycle", fix)


def require_same_settings(config: CycleConfig, folder: Path) -> None:
    """Store the settings that determine the data in `folder`; stored ones must be equal.

    Raises `ConfigurationError` with the differences: trials, value model and executions in the folder belong to one set
    of settings. Those of the training may change.
    """
    create_private_folder(folder)
    path = folder / SETTINGS_FILE
    data = msgspec.json.encode(msgspec.structs.replace(config, adapt=AdaptConfig(curation=config.adapt.curation)))
    if not path.is_file():
        write_atomically(path, msgspec.json.format(data, indent=2))
        return
    try:
        stored = _without_former_part(msgspec.json.decode(read_bounded_file(path, MAX_FILE_BYTES), type=dict[str, Any]))
    except DECODE_ERRORS as error:
        problem = f"The stored settings of the cycle cannot be read: {error}."
        raise ConfigurationError.stating(problem, fix=f"Name another --out. {path}") from error
    if differences := describe_differences(stored, msgspec.json.decode(data)):
        problem = f"The folder {folder} contains a cycle with other settings: {differences}."
        raise ConfigurationError.stating(problem, fix="Name another --out, or use the former settings.")


def _without_former_part(stored: dict[str, Any]) -> dict[str, Any]:
    """Stored settings without the part of the split that earlier versions stored, if it is the one for training."""
    if not isinstance(stored.get("training_set"), dict):
        return stored
    found = cast("dict[str, Any]", stored["training_set"])
    if found.get(FORMER_PART) != TRAINING_PART:
        return stored
    return stored | {"training_set": {name: value for name, value in found.items() if name != FORMER_PART}}


def explore_places(
    config: CycleConfig, folder: Path, on_place: Callable[[int, tuple[Trial, ...]], None] = lambda done, trials: None
) -> ValueModel:
    """Stages 1 and 2 in `folder`: the value model, stored in `VALUE_MODEL_FILE`; a stored one is not fitted again."""
    path = folder / VALUE_MODEL_FILE
    if path.is_file():
        return load_value_model(path)
    trials = explore(
        folder / EXPLORED_FOLDER, config.explored, robot=config.robot, seed=config.explored_seed, on_place=on_place
    )
    model = fit_value_model(group_siblings(trials))
    save_value_model(model, path)
    return model


def execute_choices(
    config: CycleConfig,
    folder: Path,
    value_model: ValueModel,
    *,
    cache: Path,
    on_episode: Callable[[int, Episode], None] = lambda done, episode: None,
) -> None:
    """Stage 3 in `folder`; `on_episode` gets the number of executions of all sequences so far, and the last one."""

    def execute(number: int, seed: int) -> None:
        run_proposals(
            executed_folder(folder, seed),
            config.executions,
            lambda turn: propose_best(value_model, turn, robot=config.robot, seed=seed),
            cache=cache,
            on_episode=lambda done, episode: on_episode(number * config.executions + done, episode),
        )

    for number, seed in enumerate(config.executed_seeds):
        execute(number, seed)


def executed_folder(folder: Path, seed: int) -> Path:
    """The folder with the executions of the sequence `seed`."""
    return folder / f"{EXECUTED_FOLDER}-{seed}"


def collect_clean(config: CycleConfig, folder: Path, value_model: ValueModel) -> tuple[CleanContract, ...]:
    """D_clean of all sequences; raises `MissingDependencyError` if one was not executed."""
    found: list[CleanContract] = []
    for seed in config.executed_seeds:
        ledgers = last_step_folder(executed_folder(folder, seed))
        if ledgers is None:
            raise MissingDependencyError(f"The executions of sequence {seed} in {folder}", fix="Run the cycle first.")
        clean = clean_from_ledger(ledgers, config.adapt.curation, value_model)
        found += [msgspec.structs.replace(one, memory=f"{seed}/{one.memory}") for one in clean]
    return tuple(found)


def build_cycle_dataset(
    config: CycleConfig, folder: Path, on_sample: Callable[[int], None] = lambda done: None
) -> Dataset:
    """Stage 4: the data set of the executions in `folder`; raises as `collect_clean`."""
    path = folder / VALUE_MODEL_FILE
    if not path.is_file():
        raise MissingDependencyError(f"The value model {path}", fix="Run the cycle first.")
    value_model = load_value_model(path)
    train = build_training_set(
        collect_clean(config, folder, value_model), config.robot, config.training_set, on_sample=on_sample
    )
    held_out = tuple(draw_held_out(config, value_model))
    return assemble_training_set(train, held_out, load_skill_registry(config.robot), config.adapt.curation)


def draw_held_out(config: CycleConfig, value_model: ValueModel) -> list[Sample]:
    """The samples for the loss during training: choices of the value model and rehearsal examples of another part."""
    found: dict[str, Sample] = {}
    numbers = count()
    while len(found) < config.held_out:
        if (number := next(numbers)) % REHEARSED_CHECKS:
            one = propose_best(value_model, number, robot=config.robot, part=CHECK_PART, seed=config.explored_seed)
        else:
            one = draw_rehearsal(config.robot, CHECK_PART, config.explored_seed, number)
        found.setdefault(one.id, one)
    return list(found.values())


def dataset_difference(card: DatasetCard, config: CycleConfig, folder: Path) -> str:
    """How the data set of `card` differs from that of the executions in `folder`; "" if it does not.

    The comparison uses the present skill registry, prompt and settings.
    """
    registry = load_skill_registry(config.robot)
    expected = {"form": SAMPLE_FORMAT, "robot": config.robot, "registry": registry.hash}
    if differences := card_differences(card, expected | {"scene_values": True, "site": ""}):
        return differences
    try:
        now = build_cycle_dataset(config, folder).card.hash
    except MissingDependencyError as error:
        return str(error)
    return "" if now == card.hash else f"samples {card.hash[:16]}, now {now[:16]}"
