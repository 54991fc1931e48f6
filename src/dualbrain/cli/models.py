"""dualbrain models: list planners and model files, and download them."""

from __future__ import annotations

from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TimeRemainingColumn, TransferSpeedColumn

from dualbrain.cli.common.console import StderrConsole, print_message, print_table
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.planner_choice import base_model, is_downloaded
from dualbrain.core import weights
from dualbrain.core.paths import cache_folder
from dualbrain.errors import UnknownNameError, UsageError
from dualbrain.planner.registry import DEFAULT_PLANNER

EXAMPLE = f"dualbrain models fetch {DEFAULT_PLANNER}"


def list_models() -> int:
    """List the planners and model files: name, use, licence, size and state.

    Packaged planners are adapters that are part of dualbrain; each needs the model file that it was trained on.
    """
    print_table(
        ("name", "use", "licence", "size", "state"), [*_packaged_rows(), *_file_rows()], wrap_columns=("use", "state")
    )
    return ExitCode.SUCCESS


def fetch(*names: str) -> int:
    """Download model files by name, with progress; a complete file is not downloaded again.

    Parameters
    ----------
    names
        Names from `dualbrain models list`; for a packaged planner its base model is downloaded. A server URL or a GGUF
        file needs no download and is skipped.
    """
    if not names:
        raise UsageError.stating(
            "Name the models to download.", fix=f"See `dualbrain models list`; for example: {EXAMPLE}"
        )
    for name in names:
        if "://" not in name and not name.endswith(".gguf"):
            _fetch_one(base_model(name))
    return ExitCode.SUCCESS


def _packaged_rows() -> list[tuple[str, ...]]:
    """One row for each packaged planner."""
    from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names

    def state(name: str) -> str:
        base = base_model(name)
        return "ready" if is_downloaded(base, cache_folder()) else f"needs {base}"

    def size(name: str) -> str:
        return f"{sum(file.stat().st_size for file in packaged_folder(name).iterdir()) / 1e6:,.0f} MB"

    return [
        (name, f"planner, packaged (on {base_model(name)})", "Apache-2.0", size(name), state(name))
        for name in packaged_names()
    ]


def _file_rows() -> list[tuple[str, ...]]:
    """One row for each model file of the manifest."""
    return [
        (
            status.file.name,
            "planner" if status.file.filename.endswith(".gguf") else "memory",
            status.file.licence,
            f"{status.file.size / 1e6:,.0f} MB",
            _file_state(status),
        )
        for status in weights.list_weights(cache_folder())
    ]


def _file_state(status: weights.WeightStatus) -> str:
    return "verified" if status.verified else "not verified yet" if status.present else "not downloaded"


def _fetch_one(name: str) -> None:
    from dualbrain.adaptation.adapters.packaged import packaged_names

    if name not in weights.MANIFEST:
        raise UnknownNameError("model file or packaged planner", name, (*weights.MANIFEST, *packaged_names()))
    file = weights.find_weight_file(name)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
    )
    console = StderrConsole()
    if not console.is_terminal and not is_downloaded(name, cache_folder()):
        console.print(f"downloading {name} ({file.size / 1e6:,.0f} MB)")
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(name, total=file.size)
        path = weights.fetch_weights(
            name, cache_folder(), progress=lambda done, total: bar.update(task, completed=done, total=total)
        )
    print_message(f"{name}: {path} ({file.licence}, SHA-256 {file.sha256[:12]}… verified)")
