"""Robot folder: `body.json` (the model that the filter reads, editable), the import record, the report and a README.

`made.json` is the model as generated last, so the differences between it and `body.json` are the user's edits. A new
import reports its own changes and the edits, and applies the edits again; a lost edit is always reported.

The new generated model is in `made.next.json` until all files are written, and is then renamed. If an import was
interrupted, `body.json` belongs to whichever of both models it differs from least.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import msgspec

from dualbrain.core.storage.atomic_files import fsync_entry, translated_write_errors, write_atomically
from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.robots.importer.output.diff import ModelChange, find_changes, reapply_edits
from dualbrain.robots.importer.output.markdown import render_readme
from dualbrain.robots.importer.report import ImportReport
from dualbrain.robots.loader import (
    MAX_FILE_BYTES,
    MODEL_FILE,
    encode_robot,
    find_home_faults,
    find_model_faults,
    read_robot,
)
from dualbrain.robots.model import RobotModel

GENERATED_FILE, IMPORT_RECORD_FILE, REPORT_FILE, README_FILE, IMAGE_FILE = (
    "made.json",
    "recipe.json",
    "report.json",
    "README.md",
    "picture.png",
)
NEXT_FILE = "made.next.json"
"""The model of an import that is being written, or was interrupted."""


class ImportRecord(msgspec.Struct, frozen=True, kw_only=True):
    """Record of an import: file and hash of the description, and the options."""

    description: str
    sha256: str
    packages: tuple[str, ...] = ()
    base: str = ""
    tip: str = ""
    tool: str = ""
    lock: dict[str, float] = {}
    quick: bool = False
    spheres: int = 96
    seed: int = 0
    kind: str = "fixed"
    wheels: tuple[str, str] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class FolderWriteResult:
    """Result of writing a robot folder: changes by the importer, edits kept, and edits lost."""

    robot_model: RobotModel
    is_new: bool
    generator_changes: list[ModelChange]
    kept_edits: list[ModelChange]
    lost_edits: list[ModelChange]


def write_robot_folder(
    folder: Path, robot_model: RobotModel, report: ImportReport, record: ImportRecord, *, discard_edits: bool = False
) -> FolderWriteResult:
    """Write all files but the image; the user's edits of the previous model are kept unless `discard_edits` is True.

    Raises:
        ConfigurationError: The folder contains other files, or the model of another robot; or the model has a wrong
            entry, also by an edit, with which it could not be loaded.
    """
    _require_valid(robot_model, "Correct the description, or the options of the import.")
    previous, edited = _read_previous(folder, robot_model)
    generated = robot_model
    kept: list[ModelChange] = []
    lost: list[ModelChange] = []
    if previous is not None and edited is not None and not discard_edits:
        robot_model, kept, lost = reapply_edits(previous, edited, generated)
        _require_valid(robot_model, f"Change the edit in {folder / MODEL_FILE}, or import with --discard-edits.")
    folder.mkdir(parents=True, exist_ok=True)
    files = {
        NEXT_FILE: encode_robot(generated),
        IMPORT_RECORD_FILE: encode_json(record),
        REPORT_FILE: encode_json(report),
        README_FILE: render_readme(robot_model, report, kept).encode(),
        MODEL_FILE: encode_robot(robot_model),
    }
    for name, data in files.items():
        write_atomically(folder / name, data)
    with translated_write_errors(folder / GENERATED_FILE):
        (folder / NEXT_FILE).replace(folder / GENERATED_FILE)
    fsync_entry(folder / GENERATED_FILE)
    return FolderWriteResult(
        robot_model=robot_model,
        is_new=previous is None,
        generator_changes=find_changes(previous, generated) if previous else [],
        kept_edits=kept,
        lost_edits=lost,
    )


def _require_valid(robot_model: RobotModel, fix: str) -> None:
    """Raise `ConfigurationError` for a model that `read_robot` would refuse."""
    for entry, got, allowed in (*find_model_faults(robot_model), *find_home_faults(robot_model)):
        raise ConfigurationError(f"{entry} of the imported robot {robot_model.name}", got=got, allowed=allowed, fix=fix)


def read_import_files(folder: Path) -> tuple[ImportReport | None, ImportRecord | None]:
    """Report and import record of a robot folder; None for a file that does not exist.

    Raises:
        ConfigurationError: A file cannot be decoded.
    """
    report, record = folder / REPORT_FILE, folder / IMPORT_RECORD_FILE
    try:
        return (
            msgspec.json.decode(read_bounded_file(report, MAX_FILE_BYTES), type=ImportReport)
            if report.is_file()
            else None,
            msgspec.json.decode(read_bounded_file(record, MAX_FILE_BYTES), type=ImportRecord)
            if record.is_file()
            else None,
        )
    except DECODE_ERRORS as error:
        raise ConfigurationError.stating(
            f"{REPORT_FILE} or {IMPORT_RECORD_FILE} cannot be read: {error}.",
            fix=f"Import the robot again with `dualbrain robot init`. {folder}",
        ) from error


def find_edits(folder: Path) -> list[ModelChange]:
    """The changes that a user made in `folder` since the model was generated."""
    generated = _read_generated(folder)
    return find_changes(generated, read_robot(folder)) if generated is not None else []


def encode_json(value: msgspec.Struct) -> bytes:
    """`value` as indented JSON with a final newline."""
    return msgspec.json.format(msgspec.json.encode(value), indent=1) + b"\n"


def _read_previous(folder: Path, robot_model: RobotModel) -> tuple[RobotModel | None, RobotModel | None]:
    """The model in `folder` as generated last, and with the user's edits; None if it does not exist."""
    if not folder.exists() or not any(folder.iterdir()):
        return None, None
    generated = _read_generated(folder)
    if generated is None:
        raise ConfigurationError.stating(
            f"The folder {folder} contains files, but is not a robot folder.",
            fix="Choose a new or empty folder, or a robot folder, with --out.",
        )
    if generated.name != robot_model.name:
        raise ConfigurationError.stating(
            f"The folder {folder} contains the robot {generated.name!r}, not {robot_model.name!r}.",
            fix="Choose another folder with --out.",
        )
    return generated, read_robot(folder) if (folder / MODEL_FILE).is_file() else None


def _read_generated(folder: Path) -> RobotModel | None:
    """The generated model to which `body.json` belongs; None if there is none."""
    models = [read_robot(folder / name) for name in (GENERATED_FILE, NEXT_FILE) if (folder / name).is_file()]
    if len(models) < 2 or not (folder / MODEL_FILE).is_file():
        return models[0] if models else None
    edited = read_robot(folder)
    return min(models, key=lambda generated: len(find_changes(generated, edited)))
