"""Preparation of a part: pilot episodes, start ledgers and answers that the evaluation's folder contains already."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.evaluation.runner.runner import CONFIG_FILE, EPSILON_FILE, Runner
from dualbrain.evaluation.runner.work_units import Stage
from dualbrain.evaluation.runner.worker import ANSWERS_FOLDER, START_FOLDER

PREPARED_STAGES: tuple[Stage, ...] = ("pilot", "start", "plan")
"""Stages whose results a part may take over."""


def take_over_preparation(whole: Runner, part: Runner) -> bool:
    """Copy the preparation in the folder of the `whole` evaluation to the new folder of a `part`.

    Returns whether the pilot episodes and the start ledgers were taken over. Nothing is copied to a folder that has
    results already, or from a folder whose pilot episodes or start ledgers are not complete.
    """
    if not (whole.out / CONFIG_FILE).is_file() or (part.out / CONFIG_FILE).exists():
        return False
    if whole.remaining_units("pilot") or whole.remaining_units("start"):
        return False
    create_private_folder(part.out)
    copy_new_files(whole.out, part.out, (START_FOLDER, ANSWERS_FOLDER))
    for name in (*(whole.log(stage).path.name for stage in PREPARED_STAGES), EPSILON_FILE):
        if (whole.out / name).is_file():
            write_atomically(part.out / name, (whole.out / name).read_bytes())
    return True


def copy_new_files(source: Path, target: Path, folders: Iterable[str]) -> None:
    """Copy the files of `folders` inside `source` that `target` lacks; lock files and unfinished files stay behind."""
    for folder in folders:
        for path in sorted((source / folder).rglob("*")):
            to = target / path.relative_to(source)
            if path.is_file() and not _is_temporary(path) and not to.exists():
                create_private_folder(to.parent)
                write_atomically(to, path.read_bytes())


def _is_temporary(path: Path) -> bool:
    return path.name == "lock" or path.name.startswith(".") or "partial" in path.parts
