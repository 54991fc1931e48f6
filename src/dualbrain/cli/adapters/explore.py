"""`dualbrain adapters explore`: one cycle of adaptation by exploration, from an empty folder to an adapter."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from itertools import count
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
from dualbrain.errors import ConfigurationError, UsageError

if TYPE_CHECKING:
    from dualbrain.adaptation.training.process_group import ProcessGroup
    from dualbrain.runtime.data_collection.exploration.cycle import CycleConfig

Flag = Annotated[bool, Parameter(negative="")]


def explore(
    *,
    robot: str = "",
    base: str = "base-135m",
    config: Path | None = None,
    out: Path | None = None,
    dataset_only: Flag = False,
    json: Flag = False,
) -> int:
    """Adapt a planner by exploration in simulation: explore, choose, execute, curate, train.

    Named alternatives of a contract are executed at some places in the kinematic twin. A value model is fitted to
    their outcomes. Its choices at new places are executed in the full simulation, the clean ones become training
    samples in several wordings, and an adapter is trained on them. It is not used before its promotion. An interrupted
    run resumes with the same command and the same --out. With the default settings the executions take about an hour
    on one idle processor, and the training two.

    Parameters
    ----------
    robot
        The simulated arm; default that of the settings, or panda.
    base
        The base model: from `dualbrain models list`, or base-135m.
    config
        A TOML file with the settings of the cycle (docs/explanation/adaptation.md).
    out
        The folder for trials, ledgers, data set, checkpoints and adapter; default a new folder under runs.
    dataset_only
        Stop after the data set, so that it can be trained on another machine.
    json
        Print the card of the adapter, or of the data set, as one JSON object on stdout.
    """
    from dualbrain.adaptation.adapters.base_models import require_base_model

    require_base_model(base)
    settings = _settings(robot, config)
    folder = out or Path("runs") / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-explore-{settings.robot}"
    if dataset_only:
        with training.announce_folder(folder, StderrConsole()):
            data = write_explored_dataset("this cycle", settings, folder)
            if json:
                print_json(data.card)
        return ExitCode.SUCCESS
    with process_group(training.import_trainer, out) as group, training.announce_folder(folder, console_of(group)):
        group.run_on_first(lambda: write_explored_dataset("this cycle", settings, folder))
        return _fit(settings, base, folder, group, json=json)


def _settings(robot: str, config: Path | None) -> CycleConfig:
    """The settings in the file `config`, or the default ones for `robot`."""
    from msgspec.structs import replace

    from dualbrain.robots.loader import load_robot
    from dualbrain.runtime.data_collection.exploration.cycle import CycleConfig, read_cycle_config

    settings = read_cycle_config(config) if config else CycleConfig()
    settings = replace(settings, robot=robot) if robot else settings
    if load_robot(settings.robot).is_mobile:
        problem = f"The robot {settings.robot} has a mobile base, and the kinematic twin has none."
        raise UsageError.stating(problem, fix="Name an arm with --robot, such as panda or ur5e.")
    return settings


def write_explored_dataset(name: str, config: CycleConfig, folder: Path) -> Any:
    """Run the cycle up to its data set in `folder` and return it; an existing one must be that of `name`."""
    from dualbrain.adaptation.curation.dataset import read_dataset, read_dataset_card, write_dataset
    from dualbrain.runtime.data_collection.exploration import cycle

    console = StderrConsole()
    cycle.require_same_settings(config, folder)
    if (folder / DATASET_FOLDER / "dataset.json").is_file():
        console.print("comparing the data set with the executions (minutes)")
        others = cycle.dataset_difference(read_dataset_card(folder / DATASET_FOLDER), config, folder)
        require_same_dataset(name, folder, others)
        console.print(f"using the data set in {folder}", markup=False)
    else:
        value_model = cycle.explore_places(config, folder, _place_printer(console, config.explored))
        on_episode = episode_printer(console, len(config.executed_seeds) * config.executions)
        cycle.execute_choices(config, folder, value_model, cache=cache_folder(), on_episode=on_episode)
        console.print("building the training set (minutes)")
        write_dataset(cycle.build_cycle_dataset(config, folder), folder / DATASET_FOLDER)
    data = read_dataset(folder / DATASET_FOLDER)
    console.print(
        f"{data.card.memories} clean contracts, {data.card.train} samples to train on, {data.card.held_out} held out"
    )
    return data


def require_same_dataset(name: str, folder: Path, others: str) -> None:
    """Raise `ConfigurationError` if the data set in `folder` differs, in `others`, from that of `name`."""
    if others:
        problem = f"The data set in {folder} is not the present data set of {name}: {others}."
        raise ConfigurationError.stating(problem, fix="Name another --out to make it again.")


def _place_printer(console: StderrConsole, number: int) -> Callable[[int, Any], None]:
    """Prints each explored place with its successes and the remaining time."""
    start, explored = time.monotonic(), count(1)

    def print_place(done: int, trials: Any) -> None:
        left = (time.monotonic() - start) / next(explored) * (number - done)
        succeeded = sum(one.kind == "succeeded" for one in trials)
        console.print(f"place {done}/{number}  {succeeded} of {len(trials)} succeed  {left / 60.0:.1f} min left")

    return print_place


def episode_printer(console: StderrConsole, number: int) -> Callable[[int, Any], None]:
    """Prints each episode with the remaining time, at the pace of those since the start of this command."""
    start, executed = time.monotonic(), count(1)

    def print_episode(done: int, episode: Any) -> None:
        outcome, left = episode.outcome, (time.monotonic() - start) / next(executed) * (number - done)
        size = "" if outcome.Delta is None else f"  Δ {outcome.Delta:.4f}"
        console.print(f"episode {done}/{number}  {outcome.kind}{size}  {left / 60.0:.1f} min left")

    return print_episode


def _fit(settings: CycleConfig, base: str, folder: Path, group: ProcessGroup, *, json: bool) -> int:
    """Train an adapter on the data set in `folder`, and register it."""
    from dualbrain.adaptation.compliance import make_gate_judge
    from dualbrain.grounding.vocabulary import load_skill_registry

    judge = make_gate_judge(load_skill_registry(settings.robot))
    card = training.train_adapter(base, settings.adapt, judge, folder, group)
    return group.run_on_first(lambda: _finish(card, folder, base, json=json))


def _finish(card: Any, folder: Path, base: str, *, json: bool) -> ExitCode:
    """Register the adapter in `folder` and print the next commands."""
    training.register_adapter(folder)
    training.print_next_commands(card, folder, serving=base)
    if json:
        print_json(card)
    return ExitCode.SUCCESS
