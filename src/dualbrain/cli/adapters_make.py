"""dualbrain adapters make: the adapters that dualbrain ships, made again from nothing but the base model."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from dualbrain.cli.console import Account
from dualbrain.cli.exits import Exit
from dualbrain.cli.folders import cache
from dualbrain.cli.memory_open import tell
from dualbrain.errors import UnknownName

DATASET = "dataset"
Flag = Annotated[bool, Parameter(negative="")]


def make(name: str, /, *, out: Path | None = None, json: Flag = False) -> int:
    """Make a shipped adapter again: draw its lessons, fit it, write it with its card.

    base-135m is SmolLM2 taught the language of contracts of panda, ur5e and base: templates with random valid
    parameters, nothing carried out. It plans, and knows nothing of any body. starter-135m is SmolLM2 after a first
    night: such contracts for the panda, each carried out in its scene, and those taught that went well. Interrupted in
    any way, the same command with the same --out goes on where it was.

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
        raise UnknownName("shipped adapter", name, tuple(_MAKERS))
    card = _MAKERS[name](out or Path("runs") / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{name}")
    if json:
        tell(card)
    return Exit.SUCCESS


def _base_135m(folder: Path) -> Any:
    from dualbrain.adaptation.bases import find_base
    from dualbrain.adaptation.dataset import read_dataset, write_dataset
    from dualbrain.adaptation.lessons.course import CHECKS, DIALS, LESSONS, course, language_judge
    from dualbrain.cli.adapt import adapt_with_torch, step_words
    from dualbrain.runtime.classroom import ROBOTS, lessons
    from dualbrain.runtime.vocabulary import vocabulary

    night, account = adapt_with_torch(), Account()
    registries = {robot: vocabulary(robot) for robot in ROBOTS}
    if (folder / DATASET / "dataset.json").is_file():
        account.print(f"going on with the lessons in {folder}")
    else:
        write_dataset(course(lessons(LESSONS, "teach"), lessons(CHECKS, "check"), registries), folder / DATASET)
    card = night.adapt(
        read_dataset(folder / DATASET), DIALS, find_base("smollm2-135m-instruct", cache()), language_judge(registries),
        folder, cache=cache(), clock=time.monotonic, tell=lambda progress: account.print(step_words(progress)),
    )  # fmt: skip
    account.print(f"adapter {card.id} in {folder / 'adapter'}")
    return card


def _starter_135m(folder: Path) -> Any:
    from dualbrain.adaptation.bases import find_base
    from dualbrain.adaptation.dataset import read_dataset, write_dataset
    from dualbrain.adaptation.lessons.course import language_judge
    from dualbrain.cli.adapt import adapt_with_torch, step_words
    from dualbrain.runtime import starter
    from dualbrain.runtime.proposals import ROBOT
    from dualbrain.runtime.vocabulary import vocabulary

    night, account, registry = adapt_with_torch(), Account(), vocabulary(ROBOT)
    if (folder / DATASET / "dataset.json").is_file():
        account.print(f"going on with the data set in {folder}")
    else:
        told = _flights_told(account, starter.PROPOSALS)
        day = starter.first_day(folder / "day", starter.PROPOSALS, cache=cache(), tell=told)
        write_dataset(starter.taught(day), folder / DATASET)
    data = read_dataset(folder / DATASET)
    reasons = "".join(f"; {number} {reason}" for reason, number in data.card.left_out.items())
    account.print(f"{data.card.train} samples to train on, {data.card.held_out} held out{reasons}")
    card = night.adapt(
        data, starter.DIALS, find_base(starter.BASE, cache()), language_judge({ROBOT: registry}), folder,
        cache=cache(), clock=time.monotonic, tell=lambda progress: account.print(step_words(progress)),
    )  # fmt: skip
    account.print(f"adapter {card.id} in {folder / 'adapter'}")
    return card


def _flights_told(account: Account, number: int) -> Callable[[int, Any], None]:
    """Prints each flight with the time left, at the pace of those since the start of this command."""
    began, flown = time.monotonic(), count(1)

    def told(done: int, episode: Any) -> None:
        outcome, left = episode.outcome, (time.monotonic() - began) / next(flown) * (number - done)
        size = "" if outcome.Delta is None else f"  Δ {outcome.Delta:.4f}"
        account.print(f"flight {done}/{number}  {outcome.kind}{size}  {left / 60.0:.1f} min left")

    return told


_MAKERS: dict[str, Callable[[Path], Any]] = {"base-135m": _base_135m, "starter-135m": _starter_135m}
