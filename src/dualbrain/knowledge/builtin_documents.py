"""The documents that come with dualbrain; they enter a library like any other, and can be taken down for good."""

from __future__ import annotations

import hashlib
from pathlib import Path

from dualbrain.core.encoder import Encoder
from dualbrain.errors import ConfigurationError
from dualbrain.knowledge.document import DocumentKind, TrustLevel
from dualbrain.knowledge.library import Addition, Library, Submission
from dualbrain.knowledge.rejection import DocumentRejected

DATA_FOLDER = Path(__file__).parent / "data"
BUILTIN_DOCUMENTS: dict[str, DocumentKind] = {
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
ROBOTS_BY_FILE = {"panda-hand.md": ("panda",), "ur5e-notes.md": ("ur5e",), "panda-templates.toml": ("panda",)}
"""Whom a document is about, where it is not about all."""
BUILTIN_TRUST: TrustLevel = "vendor"


def add_builtin_documents(library: Library, *, now: float) -> tuple[Addition, ...]:
    """Put up the documents that `library` has never seen, or not in today's version.

    One that somebody took down, or replaced by a document of their own of the same name, stays as they left it.
    """
    done: list[Addition] = []
    for file, kind in BUILTIN_DOCUMENTS.items():
        if not _needs_update(library, file):
            continue
        data, bodies = (DATA_FOLDER / file).read_bytes(), ROBOTS_BY_FILE.get(file, ())
        added = library.add(Submission(file=file, data=data, trust=BUILTIN_TRUST, kind=kind, robots=bodies), now=now)
        if isinstance(added, DocumentRejected):
            raise ConfigurationError(f"shipped document {file}", got=str(added), allowed="a document", fix="Reinstall.")
        if added.change != "unchanged":
            done.append(added)
    return tuple(done)


def open_library(path: Path, encoder: Encoder, *, now: float) -> Library:
    """The library at `path` with today's shipped documents; it is written only if one of them is missing or old."""
    if path.exists():
        library = Library(path, encoder)
        if not any(_needs_update(library, file) for file in BUILTIN_DOCUMENTS):
            return library
        library.close()
    library = Library(path, encoder, write=True)
    add_builtin_documents(library, now=now)
    return library


def _needs_update(library: Library, file: str) -> bool:
    """Whether `library` has never seen this document, or has an older version of it that nobody touched."""
    history = [one for _, one in library.history(Path(file).stem)]
    if not history:
        return True
    last = history[-1]
    if last is None or last.trust != BUILTIN_TRUST or last.file != file:
        return False
    return last.source != hashlib.sha256((DATA_FOLDER / file).read_bytes()).hexdigest()
