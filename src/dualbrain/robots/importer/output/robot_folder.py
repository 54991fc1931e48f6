"""A robot's folder: `body.json` (what the filter reads, to be edited), how it was made, and a page for people.

`made.json` is the body as it was made last; the difference to `body.json` are a person's edits. Making again shows both
differences and puts the edits back; nothing is lost in silence.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import msgspec

from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.robots.importer.output.diff import ModelChange, find_changes, reapply_edits
from dualbrain.robots.importer.output.markdown import render_readme
from dualbrain.robots.importer.report import ImportReport
from dualbrain.robots.loader import MODEL_FILE, encode_robot, read_robot
from dualbrain.robots.model import RobotModel

GENERATED_FILE, IMPORT_RECORD_FILE, REPORT_FILE, README_FILE, PICTURE_FILE = (
    "made.json",
    "recipe.json",
    "report.json",
    "README.md",
    "picture.png",
)


class ImportRecord(msgspec.Struct, frozen=True, kw_only=True):
    """How the body was made: the description's file and hash, and what was asked for."""

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
    """What writing a folder did: changes by this making, edits that were kept, and edits that found no place."""

    robot_model: RobotModel
    is_new: bool
    generator_changes: list[ModelChange]
    kept_edits: list[ModelChange]
    lost_edits: list[ModelChange]


def write_robot_folder(
    folder: Path, robot_model: RobotModel, report: ImportReport, record: ImportRecord, *, discard_edits: bool = False
) -> FolderWriteResult:
    """Write everything but the picture; a person's edits of an earlier body stay, unless they are to be discarded.

    Raises:
        InvalidSetup: the folder holds something that is not ours, or a body of another robot.
    """
    before, edited = _read_previous(folder, robot_model)
    made = robot_model
    kept: list[ModelChange] = []
    lost: list[ModelChange] = []
    if before is not None and edited is not None and not discard_edits:
        robot_model, kept, lost = reapply_edits(before, edited, made)
    folder.mkdir(parents=True, exist_ok=True)
    files = {
        GENERATED_FILE: encode_robot(made),
        IMPORT_RECORD_FILE: encode_json(record),
        REPORT_FILE: encode_json(report),
        README_FILE: render_readme(robot_model, report, kept).encode(),
        MODEL_FILE: encode_robot(robot_model),
    }
    for name, data in files.items():
        _write_atomically(folder / name, data)
    return FolderWriteResult(
        robot_model=robot_model,
        is_new=before is None,
        generator_changes=find_changes(before, made) if before else [],
        kept_edits=kept,
        lost_edits=lost,
    )


def read_import_files(folder: Path) -> tuple[ImportReport | None, ImportRecord | None]:
    """What stands beside a body: its report and recipe, None where there is none."""
    report, recipe = folder / REPORT_FILE, folder / IMPORT_RECORD_FILE
    try:
        return (
            msgspec.json.decode(report.read_bytes(), type=ImportReport) if report.is_file() else None,
            msgspec.json.decode(recipe.read_bytes(), type=ImportRecord) if recipe.is_file() else None,
        )
    except DECODE_ERRORS as error:
        raise ConfigurationError(
            "report of the robot", got=str(error), allowed="as written", fix=str(folder)
        ) from error


def find_edits(folder: Path) -> list[ModelChange]:
    """What a person changed in `folder` since the body was made."""
    made = folder / GENERATED_FILE
    return find_changes(read_robot(made), read_robot(folder)) if made.is_file() else []


def file_sha256(file: Path) -> str:
    """Hash of a file's content."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def encode_json(value: msgspec.Struct) -> bytes:
    """Indented JSON with a final newline."""
    return msgspec.json.format(msgspec.json.encode(value), indent=1) + b"\n"


def _read_previous(folder: Path, robot_model: RobotModel) -> tuple[RobotModel | None, RobotModel | None]:
    """The body as made last, and as it stands."""
    if not folder.exists() or not any(folder.iterdir()):
        return None, None
    if not (folder / GENERATED_FILE).is_file():
        raise ConfigurationError(
            "folder", got=f"files that are not a robot's, in {folder}", allowed="new, empty, or a robot's"
        )
    made = read_robot(folder / GENERATED_FILE)
    if made.name != robot_model.name:
        raise ConfigurationError(
            "folder", got=f"the robot {made.name!r}", allowed=repr(robot_model.name), fix=f"--out. {folder}"
        )
    return made, read_robot(folder) if (folder / MODEL_FILE).is_file() else None


def _write_atomically(path: Path, data: bytes) -> None:
    """Write beside, then rename: a reader sees the old file or the new one."""
    beside = path.with_name(f".{path.name}.new")
    beside.write_bytes(data)
    beside.replace(path)
