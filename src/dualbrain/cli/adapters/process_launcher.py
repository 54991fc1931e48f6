"""Training in several processes under a launcher (`torchrun`, `accelerate launch`), else in a single one."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dualbrain.adaptation.training.process_group import SINGLE_PROCESS, ProcessGroup
from dualbrain.cli.common.console import StderrConsole
from dualbrain.errors import ConfigurationError


def is_distributed(environ: Mapping[str, str] = os.environ) -> bool:
    """Whether a launcher started this process as one of several, according to the environment.

    Raises `ConfigurationError` if WORLD_SIZE is not a number.
    """
    size = environ.get("WORLD_SIZE", "1")
    if not size.isdecimal():
        fix = "A launcher sets it; without a launcher, use `unset WORLD_SIZE`."
        raise ConfigurationError("WORLD_SIZE in the environment", got=size, allowed="a number of processes", fix=fix)
    return int(size) > 1


@contextmanager
def process_group(load: Callable[[], Any], out: Path | None) -> Generator[ProcessGroup]:
    """The processes of this training run; `load` imports torch.

    Raises `ConfigurationError` if there are several and `out` is not named, `MissingDependencyError` without torch.
    """
    if not is_distributed():
        yield SINGLE_PROCESS
        return
    if out is None:
        problem = "Training in several processes needs --out."
        raise ConfigurationError.stating(problem, fix="Name one folder that all processes can read.")
    load()
    from dualbrain.adaptation.training.accelerate_group import join_process_group

    with join_process_group() as group:
        yield group


def console_of(group: ProcessGroup) -> StderrConsole:
    """The console of the first process; it is silent in the others."""
    console = StderrConsole()
    console.quiet = group.rank > 0
    return console
