"""A robot's folder: `body.json` (what the filter reads, to be edited), how it was made, and a page for people.

`made.json` is the body as it was made last; the difference to `body.json` are a person's edits. Making again shows both
differences and puts the edits back; nothing is lost in silence.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import msgspec

from dualbrain.errors import UNREADABLE, InvalidSetup
from dualbrain.robots.importer.output.diff import Change, changes, keep_edits
from dualbrain.robots.importer.output.markdown import page
from dualbrain.robots.importer.report import Report
from dualbrain.robots.loader import FILE, encode, read_body
from dualbrain.robots.model import Body

MADE, RECIPE, REPORT, PAGE, PICTURE = "made.json", "recipe.json", "report.json", "README.md", "picture.png"


class Recipe(msgspec.Struct, frozen=True):
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


@dataclass(frozen=True, slots=True)
class Written:
    """What writing a folder did: changes by this making, edits that were kept, and edits that found no place."""

    body: Body
    new: bool
    by_making: list[Change]
    kept: list[Change]
    lost: list[Change]


def write_folder(folder: Path, body: Body, report: Report, recipe: Recipe, *, discard_edits: bool = False) -> Written:
    """Write everything but the picture; a person's edits of an earlier body stay, unless they are to be discarded.

    Raises:
        InvalidSetup: the folder holds something that is not ours, or a body of another robot.
    """
    before, edited = _earlier(folder, body)
    made = body
    kept: list[Change] = []
    lost: list[Change] = []
    if before is not None and edited is not None and not discard_edits:
        body, kept, lost = keep_edits(before, edited, made)
    folder.mkdir(parents=True, exist_ok=True)
    files = {
        MADE: encode(made), RECIPE: encoded(recipe), REPORT: encoded(report), PAGE: page(body, report, kept).encode(),
        FILE: encode(body),
    }  # fmt: skip
    for name, data in files.items():
        _replace(folder / name, data)
    return Written(body, before is None, changes(before, made) if before else [], kept, lost)


def read_report(folder: Path) -> tuple[Report | None, Recipe | None]:
    """What stands beside a body: its report and recipe, None where there is none."""
    report, recipe = folder / REPORT, folder / RECIPE
    try:
        return (
            msgspec.json.decode(report.read_bytes(), type=Report) if report.is_file() else None,
            msgspec.json.decode(recipe.read_bytes(), type=Recipe) if recipe.is_file() else None,
        )
    except UNREADABLE as error:
        raise InvalidSetup("report of the robot", got=str(error), allowed="as written", fix=str(folder)) from error


def edits(folder: Path) -> list[Change]:
    """What a person changed in `folder` since the body was made."""
    made = folder / MADE
    return changes(read_body(made), read_body(folder)) if made.is_file() else []


def sha256(file: Path) -> str:
    """Hash of a file's content."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def encoded(value: msgspec.Struct) -> bytes:
    """Indented JSON with a final newline."""
    return msgspec.json.format(msgspec.json.encode(value), indent=1) + b"\n"


def _earlier(folder: Path, body: Body) -> tuple[Body | None, Body | None]:
    """The body as made last, and as it stands."""
    if not folder.exists() or not any(folder.iterdir()):
        return None, None
    if not (folder / MADE).is_file():
        raise InvalidSetup(
            "folder", got=f"files that are not a robot's, in {folder}", allowed="new, empty, or a robot's"
        )
    made = read_body(folder / MADE)
    if made.name != body.name:
        raise InvalidSetup("folder", got=f"the robot {made.name!r}", allowed=repr(body.name), fix=f"--out. {folder}")
    return made, read_body(folder) if (folder / FILE).is_file() else None


def _replace(path: Path, data: bytes) -> None:
    """Write beside, then rename: a reader sees the old file or the new one."""
    beside = path.with_name(f".{path.name}.new")
    beside.write_bytes(data)
    beside.replace(path)
