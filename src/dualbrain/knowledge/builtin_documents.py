"""The built-in documents of dualbrain; they are added to a library like others and can be removed permanently."""

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
"""Kind of each file; a test checks that every file of the folder is listed."""
ROBOTS_BY_FILE = {"panda-hand.md": ("panda",), "ur5e-notes.md": ("ur5e",), "panda-templates.toml": ("panda",)}
"""Robots that a document is about; the others are about all robots."""
BUILTIN_TRUST: TrustLevel = "vendor"


def add_builtin_documents(library: Library, *, now: float) -> tuple[Addition, ...]:
    """Add the built-in documents that `library` has never contained, or not in the present version; returns these.

    A document that was removed, or replaced by another document of the same name, is left as it is. Raises
    `ConfigurationError` if a built-in document cannot be read.
    """
    additions: list[Addition] = []
    for file, kind in BUILTIN_DOCUMENTS.items():
        if not _needs_update(library, file):
            continue
        data, robots = (DATA_FOLDER / file).read_bytes(), ROBOTS_BY_FILE.get(file, ())
        added = library.add(Submission(file=file, data=data, trust=BUILTIN_TRUST, kind=kind, robots=robots), now=now)
        if isinstance(added, DocumentRejected):
            sentence = f"The built-in document {file} cannot be added. {added}"
            raise ConfigurationError.stating(sentence, fix="Reinstall dualbrain.")
        if added.change != "unchanged":
            additions.append(added)
    return tuple(additions)


def open_library(path: Path, encoder: Encoder, *, now: float) -> Library:
    """The library at `path` with the present built-in documents; it is written only if one is missing or outdated."""
    if path.exists():
        library = Library(path, encoder)
        if not any(_needs_update(library, file) for file in BUILTIN_DOCUMENTS):
            return library
        library.close()
    library = Library(path, encoder, write=True)
    add_builtin_documents(library, now=now)
    return library


def _needs_update(library: Library, file: str) -> bool:
    """Whether `library` never contained this document, or contains an unchanged older version of it."""
    history = [one for _, one in library.history(Path(file).stem)]
    if not history:
        return True
    last = history[-1]
    if last is None or last.trust != BUILTIN_TRUST or last.file != file:
        return False
    return last.source != hashlib.sha256((DATA_FOLDER / file).read_bytes()).hexdigest()
