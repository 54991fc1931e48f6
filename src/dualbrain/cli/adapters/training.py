"""Training of an adapter in an output folder, as the commands share it: progress, registration, next commands."""

from __future__ import annotations

import shlex
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dualbrain.cli.adapters.process_launcher import console_of
from dualbrain.cli.common.console import StderrConsole
from dualbrain.core.paths import cache_folder
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.planner.registry import DEFAULT_PLANNER

if TYPE_CHECKING:
    from dualbrain.adaptation.training.process_group import ProcessGroup

DATASET_FOLDER, ADAPTER_FOLDER = "dataset", "adapter"
"""Folders of the data set and of the adapter in an output folder."""


@contextmanager
def announce_folder(folder: Path, console: StderrConsole) -> Generator[None]:
    """Print the output `folder`, and after Ctrl-C how to resume the run there."""
    print_unwrapped(console, f"all files are kept in {folder}")
    try:
        yield
    except KeyboardInterrupt:
        print_unwrapped(console, f"resume with the same command and --out {shlex.quote(str(folder))}")
        raise


def print_unwrapped(console: StderrConsole, line: str) -> None:
    """Print `line` without markup or wrapping, so that a path or a command can be copied."""
    console.print(line, markup=False, soft_wrap=True)


def import_trainer() -> Any:
    """The training module; raises `MissingDependencyError` without the extra `adapt`."""
    try:
        from dualbrain.adaptation.training import train
    except ModuleNotFoundError as error:
        fix = "Install it with `pip install 'dualbrain[adapt]'`."
        raise MissingDependencyError(f"The package {error.name} of the extra `adapt`", fix=fix) from error
    return train


def train_adapter(
    base: str,
    settings: Any,
    judge: Callable[..., Any],
    folder: Path,
    group: ProcessGroup,
    *,
    dataset: Any = None,
    own_adapters: Sequence[str] = (),
) -> Any:
    """Train an adapter of `base` on the data set in `folder`, with its progress on stderr; returns its card.

    `dataset` is the data set if it was read already. `judge` and `own_adapters` are those of `train.adapt`.
    """
    from dualbrain.adaptation.adapters.base_models import find_base_model
    from dualbrain.adaptation.curation.dataset import read_dataset

    train, console = import_trainer(), console_of(group)
    return train.adapt(
        read_dataset(folder / DATASET_FOLDER) if dataset is None else dataset,
        settings,
        find_base_model(base, cache_folder()),
        judge,
        folder,
        cache=cache_folder(),
        clock=time.monotonic,
        report=lambda progress: console.print(_format_step(progress)),
        process_group=group,
        own_adapters=own_adapters,
    )


def register_adapter(folder: Path) -> None:
    """Add the adapter in `folder` to the registry."""
    from dualbrain.cli.adapters.registry import open_adapter_registry

    open_adapter_registry().add(folder / ADAPTER_FOLDER, now=time.time())


def print_next_commands(card: Any, folder: Path, *, ledger: Path | None = None, serving: str = DEFAULT_PLANNER) -> None:
    """Print the commands that bring the new adapter of `card` into service, or why its data set does not suffice.

    `serving` is the planner in service, unless another adapter serves in the place of the new one.
    """
    from dualbrain.adaptation.adapters.registry import place_of_card
    from dualbrain.cli.adapters.registry import open_adapter_registry

    registry, console = open_adapter_registry(), StderrConsole()
    unused = f"adapter {card.id[:16]}; it is not used until it is promoted."
    if problem := _measurement_problem(folder / DATASET_FOLDER, card.robot):
        fix = "Measure it with a larger data set, or train again with more clean episodes or a larger held-out part."
        console.print(f"{unused} `dualbrain adapters measure` refuses its data set. {problem} {fix}", markup=False)
        return
    console.print(f"{unused} Next, in this order:")
    beside = "" if registry.champion(place_of_card(card)) else f"@{serving}"
    for line in _next_commands(card, folder, ledger, beside):
        print_unwrapped(console, f"  {line}")


def _measurement_problem(data: Path, robot: str) -> str:
    """Why the held-out questions for `robot` in the data set `data` justify no promotion; "" if they can."""
    from dualbrain.adaptation.curation.dataset import read_dataset
    from dualbrain.adaptation.serving.measurement import samples_for_robot, select_questions

    try:
        select_questions(samples_for_robot(read_dataset(data).held_out, robot))
    except ConfigurationError as error:
        return str(error)
    return ""


def _next_commands(card: Any, folder: Path, ledger: Path | None, beside: str) -> tuple[str, ...]:
    """The commands that bring a new adapter into service, first in the shadow of the planner `beside` ("@NAME")."""
    one, results = card.id[:16], folder / "measured.json"
    data, measured = (shlex.quote(str(path)) for path in (folder / DATASET_FOLDER, results))
    of = f" --ledger {shlex.quote(str(ledger))}" if ledger else ""
    return (
        f"dualbrain adapters measure {one} --data {data} --out {measured}{of}",
        f'dualbrain run "…" --robot {card.robot} --planner shadow:{one}{beside}',
        f"dualbrain adapters promote {one} --measured {measured}",
    )


def _format_step(progress: Any) -> str:
    """One line of progress for a person."""
    line = f"step {progress.step}/{progress.steps}  loss {progress.cross_entropy:.3f}  KL {progress.divergence:.4f}"
    if progress.held_out is not None:
        compliance, loss = progress.held_out.compliance, progress.held_out.loss
        line += f"  held out: {'' if compliance is None else f'{compliance:.0%} compliant, '}loss {loss:.3f}"
    return f"{line}  {progress.seconds_left / 60.0:.1f} min left"
