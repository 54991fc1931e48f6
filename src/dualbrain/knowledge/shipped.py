"""The documents that come with dualbrain; they enter a library like any other, and can be taken down for good."""

from __future__ import annotations

from pathlib import Path

from dualbrain.errors import InvalidSetup
from dualbrain.knowledge.document import Kind, Trust
from dualbrain.knowledge.library import Addition, Library, Submission
from dualbrain.knowledge.refusal import Refused

DATA = Path(__file__).parent / "data"
SHIPPED: dict[str, Kind] = {
    "site-rules.md": "rule",
    "panda-hand.md": "manual",
    "ur5e-notes.md": "manual",
    "differential-base.md": "manual",
    "grasping-guide.md": "manual",
    "people-and-shared-space.md": "manual",
    "room-map.toml": "map",
    "panda-templates.toml": "template",
}
"""File and kind of each; a test holds that every file of the folder is here."""
TRUST: Trust = "vendor"


def add_shipped(library: Library, *, now: float) -> tuple[Addition, ...]:
    """Put up the documents that `library` has never seen, or not in today's version.

    One that somebody took down, or replaced by a document of their own of the same name, stays as they left it.
    """
    done: list[Addition] = []
    for file, kind in SHIPPED.items():
        history = [one for _, one in library.history(Path(file).stem)]
        if history and (history[-1] is None or history[-1].trust != TRUST or history[-1].file != file):
            continue
        added = library.add(Submission(file, (DATA / file).read_bytes(), TRUST, kind=kind), now=now)
        if isinstance(added, Refused):
            raise InvalidSetup(f"shipped document {file}", got=str(added), allowed="a document", fix="Reinstall.")
        if added.change != "unchanged":
            done.append(added)
    return tuple(done)
