"""dualbrain adapters make: the adapters that dualbrain ships, made again from nothing but the base model."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import UTC, datetime
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
    parameters, nothing carried out. It plans, and knows nothing of any body. Interrupted in any way, the same command
    with the same --out goes on where it was.

    Parameters
    ----------
    name
        Which one: base-135m.
    out
        Where lessons, checkpoints and adapter go; default a new folder under runs.
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


_MAKERS: dict[str, Callable[[Path], Any]] = {"base-135m": _base_135m}
