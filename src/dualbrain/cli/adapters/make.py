"""`dualbrain adapters make`: reproduce the packaged adapters from the base model alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from dualbrain.cli.adapters import training
from dualbrain.cli.adapters.process_launcher import console_of, process_group
from dualbrain.cli.adapters.training import DATASET_FOLDER
from dualbrain.cli.common.console import StderrConsole
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.memory.open_memory import print_json
from dualbrain.core.paths import cache_folder
from dualbrain.errors import UnknownNameError

if TYPE_CHECKING:
    from dualbrain.adaptation.training.process_group import ProcessGroup
    from dualbrain.contracts.registry import SkillRegistry

Flag = Annotated[bool, Parameter(negative="")]


def make(name: str, /, *, out: Path | None = None, json: Flag = False) -> int:
    """Reproduce a packaged adapter: generate its data set, train it, and write it with its card.

    base-135m is SmolLM2 trained on the language of contracts of panda, ur5e and base: templates with random valid
    parameters, nothing executed. It plans without any experience of a robot. starter-135m is base-135m after a first
    training run on experience: random contracts for the panda, executed in their scenes, of which the successful ones
    were selected. An interrupted run resumes with the same command and the same --out. A data set in the folder that
    differs from the adapter's present one is rejected.

    Parameters
    ----------
    name
        The adapter: base-135m or starter-135m.
    out
        The folder for data set, ledger, checkpoints and adapter; default a new folder under runs.
    json
        Print the card as one JSON object on stdout.
    """
    if name not in _MAKERS:
        raise UnknownNameError("packaged adapter", name, tuple(_MAKERS))
    folder = out or Path("runs") / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{name}"
    with process_group(training.import_trainer, out) as group, training.announce_folder(folder, console_of(group)):
        card = _MAKERS[name](folder, group)
        if json and group.rank == 0:
            print_json(card)
    return ExitCode.SUCCESS


# --- base-135m --------------------------------------------------------------------------------------------------------


def _base_135m(folder: Path, group: ProcessGroup) -> Any:
    from dualbrain.adaptation.synthetic.dataset import SYNTHETIC_ADAPT_CONFIG
    from dualbrain.grounding.vocabulary import load_skill_registry
    from dualbrain.runtime.data_collection.synthetic_scenes import ROBOT_SHARES

    registries = {robot: load_skill_registry(robot) for robot in ROBOT_SHARES}
    group.run_on_first(lambda: _write_synthetic_dataset(folder, registries))
    return _fit("smollm2-135m-instruct", SYNTHETIC_ADAPT_CONFIG, registries, folder, group)


def _write_synthetic_dataset(folder: Path, registries: Mapping[str, SkillRegistry]) -> None:
    """Write the synthetic examples to `folder`, unless they are there already."""
    from dualbrain.adaptation.curation.dataset import read_dataset_card, write_dataset
    from dualbrain.adaptation.synthetic.dataset import (
        N_CHECK_EXAMPLES,
        N_TRAIN_EXAMPLES,
        build_synthetic_dataset,
        synthetic_dataset_differences,
    )
    from dualbrain.cli.adapters.explore import require_same_dataset
    from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples

    if (folder / DATASET_FOLDER / "dataset.json").is_file():
        require_same_dataset(
            "base-135m", folder, synthetic_dataset_differences(read_dataset_card(folder / DATASET_FOLDER), registries)
        )
        StderrConsole().print(f"using the data set in {folder}", markup=False)
    else:
        write_dataset(
            build_synthetic_dataset(
                generate_examples(N_TRAIN_EXAMPLES, "teach"), generate_examples(N_CHECK_EXAMPLES, "check"), registries
            ),
            folder / DATASET_FOLDER,
        )


# --- starter-135m -----------------------------------------------------------------------------------------------------


def _starter_135m(folder: Path, group: ProcessGroup) -> Any:
    from dualbrain.grounding.vocabulary import load_skill_registry
    from dualbrain.runtime.data_collection import starter_dataset as starter
    from dualbrain.runtime.data_collection.rollouts import ROBOT

    group.run_on_first(lambda: _write_rollout_dataset(folder))
    return _fit(starter.BASE_MODEL, starter.ADAPT_CONFIG, {ROBOT: load_skill_registry(ROBOT)}, folder, group)


def _write_rollout_dataset(folder: Path) -> None:
    """Execute the proposals and write the data set of the successful ones to `folder`, unless it is there already."""
    from dualbrain.adaptation.curation.dataset import read_dataset, read_dataset_card, write_dataset
    from dualbrain.cli.adapters.explore import episode_printer, require_same_dataset
    from dualbrain.runtime.data_collection import starter_dataset as starter

    console, day = StderrConsole(), folder / "day"
    if (folder / DATASET_FOLDER / "dataset.json").is_file():
        others = starter.dataset_difference(read_dataset_card(folder / DATASET_FOLDER), day, starter.N_PROPOSALS)
        require_same_dataset("starter-135m", folder, others)
        console.print(f"using the data set in {folder}", markup=False)
    else:
        on_episode = episode_printer(console, starter.N_PROPOSALS)
        ledger_folder = starter.collect_rollouts(day, starter.N_PROPOSALS, cache=cache_folder(), on_episode=on_episode)
        write_dataset(starter.build_dataset(ledger_folder), folder / DATASET_FOLDER)
    data = read_dataset(folder / DATASET_FOLDER)
    reasons = "".join(f"; {number} {reason}" for reason, number in data.card.left_out.items())
    console.print(f"{data.card.train} samples to train on, {data.card.held_out} held out{reasons}")


# --- both -------------------------------------------------------------------------------------------------------------


def _fit(base: str, settings: Any, registries: Mapping[str, SkillRegistry], folder: Path, group: ProcessGroup) -> Any:
    """Train an adapter of `base` on the data set in `folder` and return its card."""
    from dualbrain.adaptation.synthetic.dataset import make_language_judge

    card = training.train_adapter(base, settings, make_language_judge(registries), folder, group)
    console_of(group).print(f"adapter {card.id} in {folder / training.ADAPTER_FOLDER}", markup=False)
    return card


_MAKERS: dict[str, Callable[[Path, ProcessGroup], Any]] = {"base-135m": _base_135m, "starter-135m": _starter_135m}
