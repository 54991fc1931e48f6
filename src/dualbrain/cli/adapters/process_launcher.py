"""Under a launcher (`torchrun`, `accelerate launch`) a fit is several processes on one folder; else it is one."""

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
    """Whether a launcher started this process as one of several: it says so in the environment.

    Raises `InvalidSetup` if what it says is no number.
    """
    size = environ.get("WORLD_SIZE", "1")
    if not size.isdecimal():
        fix = "A launcher sets it; without one: `unset WORLD_SIZE`."
        raise ConfigurationError("WORLD_SIZE in the environment", got=size, allowed="a number of processes", fix=fix)
    return int(size) > 1


@contextmanager
def process_group(load: Callable[[], Any], out: Path | None) -> Generator[ProcessGroup]:
    """The processes that carry out this fit; `load` imports what needs torch.

    Raises `InvalidSetup` if there are several and no common folder `out` is named, `MissingPart` without torch.
    """
    if not is_distributed():
        yield SINGLE_PROCESS
        return
    if out is None:
        fix = "Name one folder, which all processes see."
        raise ConfigurationError("--out of a fit in several processes", got="none", allowed="a folder", fix=fix)
    load()
    from dualbrain.adaptation.training.accelerate_group import join_process_group

    with join_process_group() as team:
        yield team


def console_of(group: ProcessGroup) -> StderrConsole:
    """Where the first process speaks, and the others are silent."""
    account = StderrConsole()
    account.quiet = group.rank > 0
    return account
