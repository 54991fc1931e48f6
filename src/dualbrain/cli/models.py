"""dualbrain models: which weights there are, and fetching them."""

from __future__ import annotations

import sys

from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

from dualbrain.cli.common.console import print_table
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.paths import cache_folder
from dualbrain.core import weights


def list_models() -> int:
    """List the known weights: name, licence, size, whether they are here and verified."""
    rows = [
        (status.file.name, status.file.licence, f"{status.file.size / 1e6:,.0f} MB", _local_status(status))
        for status in weights.list_weights(cache_folder())
    ]
    print_table(("name", "licence", "size", "here"), rows)
    return ExitCode.SUCCESS


def _local_status(status: weights.WeightStatus) -> str:
    return "verified" if status.verified else "present" if status.present else "-"


def fetch(*names: str) -> int:
    """Fetch weights by name, with progress; what is here and whole is not fetched again.

    Parameters
    ----------
    names
        Names from `dualbrain models list`, or of an adapter that comes with dualbrain (its base);
        the URL of a server or a GGUF file needs no weights and is passed over.
    """
    for name in names:
        if "://" not in name and not name.endswith(".gguf"):
            _fetch_one(_base_model_of(name))
    return ExitCode.SUCCESS


def _base_model_of(name: str) -> str:
    """The model that a packaged adapter sits on; any other name as it is."""
    from dualbrain.adaptation.adapters.card import read_adapter_card
    from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names

    while name in packaged_names():
        name = read_adapter_card(packaged_folder(name)).base
    return name


def _fetch_one(name: str) -> None:
    file = weights.find_weight_file(name)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(file=sys.stderr), transient=True) as bar:
        task = bar.add_task(name, total=file.size)
        path = weights.fetch_weights(
            name, cache_folder(), progress=lambda done, total: bar.update(task, completed=done, total=total)
        )
    print(f"{name}: {path} ({file.licence}, sha256 {file.sha256[:12]}… verified)", file=sys.stderr)
