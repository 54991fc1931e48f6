"""dualbrain adapters make: the adapters that dualbrain ships, made again from nothing but the base model."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from dualbrain.cli.adapters.process_launcher import console_of, process_group
from dualbrain.cli.common.console import StderrConsole
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.paths import cache_folder
from dualbrain.cli.memory.open_memory import print_json
from dualbrain.errors import ConfigurationError, UnknownNameError

if TYPE_CHECKING:
    from dualbrain.adaptation.training.process_group import ProcessGroup
    from dualbrain.contracts.registry import SkillRegistry

DATASET_FOLDER = "dataset"
Flag = Annotated[bool, Parameter(negative="")]


def make(name: str, /, *, out: Path | None = None, json: Flag = False) -> int:
    """Make a shipped adapter again: draw its lessons, fit it, write it with its card.

    base-135m is SmolLM2 taught the language of contracts of panda, ur5e and base: templates with random valid
    parameters, nothing carried out. It plans, and knows nothing of any body. starter-135m is that one after a
    first night: such contracts for the panda, each carried out in its scene, and those taught that went well.
    Interrupted in any way, the same command with the same --out goes on where it was. A data set there that is not the
    one which that adapter is taught today is refused.

    Parameters
    ----------
    name
        Which one: base-135m, starter-135m.
    out
        Where lessons, ledger, checkpoints and adapter go; default a new folder under runs.
    json
        Print the card as one JSON object on stdout.
    """
    if name not in _MAKERS:
        raise UnknownNameError("shipped adapter", name, tuple(_MAKERS))
    from dualbrain.cli.adapters.adapt import announce_folder, import_trainer

    folder = out or Path("runs") / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{name}"
    with process_group(import_trainer, out) as team, announce_folder(folder, console_of(team)):
        card = _MAKERS[name](folder, team)
        if json and team.rank == 0:
            print_json(card)
    return ExitCode.SUCCESS


# --- base-135m --------------------------------------------------------------------------------------------------------


def _base_135m(folder: Path, team: ProcessGroup) -> Any:
    from dualbrain.adaptation.synthetic.dataset import SYNTHETIC_ADAPT_CONFIG
    from dualbrain.grounding.vocabulary import load_skill_registry
    from dualbrain.runtime.data_collection.synthetic_scenes import ROBOT_SHARES

    registries = {robot: load_skill_registry(robot) for robot in ROBOT_SHARES}
    team.run_on_first(lambda: _write_synthetic_dataset(folder, registries))
    return _fit("smollm2-135m-instruct", SYNTHETIC_ADAPT_CONFIG, registries, folder, team)


def _write_synthetic_dataset(folder: Path, registries: Mapping[str, SkillRegistry]) -> None:
    """Write the lessons into `folder`, unless they are there already."""
    from dualbrain.adaptation.curation.dataset import read_dataset_card, write_dataset
    from dualbrain.adaptation.synthetic.dataset import (
        N_CHECK_EXAMPLES,
        N_TRAIN_EXAMPLES,
        build_synthetic_dataset,
        synthetic_dataset_differences,
    )
    from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples

    if (folder / DATASET_FOLDER / "dataset.json").is_file():
        _require_same_dataset(
            "base-135m", folder, synthetic_dataset_differences(read_dataset_card(folder / DATASET_FOLDER), registries)
        )
        StderrConsole().print(f"going on with the lessons in {folder}")
    else:
        write_dataset(
            build_synthetic_dataset(
                generate_examples(N_TRAIN_EXAMPLES, "teach"), generate_examples(N_CHECK_EXAMPLES, "check"), registries
            ),
            folder / DATASET_FOLDER,
        )


# --- starter-135m -----------------------------------------------------------------------------------------------------


def _starter_135m(folder: Path, team: ProcessGroup) -> Any:
    from dualbrain.grounding.vocabulary import load_skill_registry
    from dualbrain.runtime.data_collection import starter_dataset as starter
    from dualbrain.runtime.data_collection.rollouts import ROBOT

    team.run_on_first(lambda: _write_rollout_dataset(folder))
    return _fit(starter.BASE_MODEL, starter.ADAPT_CONFIG, {ROBOT: load_skill_registry(ROBOT)}, folder, team)


def _write_rollout_dataset(folder: Path) -> None:
    """Carry out what is proposed, and write what went well into `folder`, unless that is there already."""
    from dualbrain.adaptation.curation.dataset import read_dataset, read_dataset_card, write_dataset
    from dualbrain.runtime.data_collection import starter_dataset as starter

    account, day = StderrConsole(), folder / "day"
    if (folder / DATASET_FOLDER / "dataset.json").is_file():
        others = starter.dataset_difference(read_dataset_card(folder / DATASET_FOLDER), day, starter.N_PROPOSALS)
        _require_same_dataset("starter-135m", folder, others)
        account.print(f"going on with the data set in {folder}")
    else:
        told = _episode_printer(account, starter.N_PROPOSALS)
        lived = starter.collect_rollouts(day, starter.N_PROPOSALS, cache=cache_folder(), on_episode=told)
        write_dataset(starter.build_dataset(lived), folder / DATASET_FOLDER)
    data = read_dataset(folder / DATASET_FOLDER)
    reasons = "".join(f"; {number} {reason}" for reason, number in data.card.left_out.items())
    account.print(f"{data.card.train} samples to train on, {data.card.held_out} held out{reasons}")


def _episode_printer(account: StderrConsole, number: int) -> Callable[[int, Any], None]:
    """Prints each flight with the time left, at the pace of those since the start of this command."""
    began, flown = time.monotonic(), count(1)

    def told(done: int, episode: Any) -> None:
        outcome, left = episode.outcome, (time.monotonic() - began) / next(flown) * (number - done)
        size = "" if outcome.Delta is None else f"  Δ {outcome.Delta:.4f}"
        account.print(f"flight {done}/{number}  {outcome.kind}{size}  {left / 60.0:.1f} min left")

    return told


# --- both -------------------------------------------------------------------------------------------------------------


def _require_same_dataset(name: str, folder: Path, others: str) -> None:
    """Raise `InvalidSetup` if the data set in `folder` differs, in `others`, from the one that `name` is taught."""
    if others:
        fix = "It is another one's, or what it was made for has changed since. Name another --out to make it anew."
        raise ConfigurationError(f"data set in {folder}", got=others, allowed=f"what {name} is taught today", fix=fix)


def _fit(base: str, dials: Any, registries: Mapping[str, SkillRegistry], folder: Path, team: ProcessGroup) -> Any:
    """The card of an adapter of `base`, fitted on the data set in `folder`."""
    from dualbrain.adaptation.adapters.base_models import find_base_model
    from dualbrain.adaptation.curation.dataset import read_dataset
    from dualbrain.adaptation.synthetic.dataset import make_language_judge
    from dualbrain.cli.adapters.adapt import format_step, import_trainer

    account = console_of(team)
    card = import_trainer().adapt(
        read_dataset(folder / DATASET_FOLDER),
        dials,
        find_base_model(base, cache_folder()),
        make_language_judge(registries),
        folder,
        cache=cache_folder(),
        clock=time.monotonic,
        tell=lambda progress: account.print(format_step(progress)),
        team=team,
    )
    account.print(f"adapter {card.id} in {folder / 'adapter'}")
    return card


_MAKERS: dict[str, Callable[[Path, ProcessGroup], Any]] = {"base-135m": _base_135m, "starter-135m": _starter_135m}
