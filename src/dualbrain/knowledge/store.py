"""The file that knowledge lies in: one SQLite database, versions append-only, what stands on the shelf now derived.

An event says that a version was put on the shelf or taken down; a document is what its last event says. Readings and
chunks are never changed or removed, so that every citation ever given resolves. The words (FTS5) and vectors of what
stands there now are projections and can be made again.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.storage.sqlite import split_statements, transaction
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.knowledge.chunking import Chunk
from dualbrain.knowledge.document import Document
from dualbrain.knowledge.readers.reader import DocumentText
from dualbrain.knowledge.rejection import CorruptStoreError, StoreInUseError

SCHEMA_VERSION = 1
LOCK_TIMEOUT_S = 10.0
"""How long a writer waits for another one."""

_SCHEMA = f"""
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
INSERT INTO meta VALUES ('schema_version', '{SCHEMA_VERSION}');
CREATE TABLE reading (name TEXT NOT NULL, version TEXT NOT NULL, data BLOB NOT NULL, PRIMARY KEY (name, version));
CREATE TABLE chunk (id INTEGER PRIMARY KEY, name TEXT NOT NULL, version TEXT NOT NULL, start INTEGER NOT NULL,
    stop INTEGER NOT NULL, page INTEGER, path TEXT NOT NULL);
CREATE INDEX chunk_of ON chunk (name, version);
CREATE TABLE event (seq INTEGER PRIMARY KEY, time REAL NOT NULL, name TEXT NOT NULL, document BLOB);
CREATE TABLE vector (chunk INTEGER PRIMARY KEY, data BLOB NOT NULL);
CREATE VIRTUAL TABLE words USING fts5 (path, text, tokenize = 'porter unicode61 remove_diacritics 2');
""" + "".join(
    f"CREATE TRIGGER {table}_is_never_{what}d BEFORE {what.upper()} ON {table} "
    "BEGIN SELECT raise(ABORT, 'append-only'); END;\n"
    for table in ("reading", "chunk", "event")
    for what in ("update", "delete")
)


class StoredChunk(msgspec.Struct, frozen=True):
    """A chunk that stands on the shelf: its number, the document, the chunk and its text."""

    id: int
    document: Document
    chunk: Chunk
    text: str


class DocumentStore:
    """Reads and, with `write`, changes the file. A transaction is all or nothing, also when the process is killed.

    SQLite's own lock lets one writer in at a time; a rollback journal (no WAL) leaves one file at rest, which a reader
    may also open where nothing can be written.
    """

    def __init__(self, path: Path, *, write: bool) -> None:
        """Open the file; with `write` make it if it is not there.

        Raises `MissingPart`, `InvalidSetup`, `DamagedStore`.
        """
        if not write and not path.exists():
            raise MissingDependencyError(
                f"The knowledge store {path}", fix="It is made by the first `dualbrain knowledge add`."
            )
        self.path = path
        with self._translate_errors():
            if write:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._database = sqlite3.connect(path, isolation_level=None, timeout=LOCK_TIMEOUT_S)
                self._create()
            else:
                # not mode=ro: what a killed writer left half done must be rolled back by whoever opens the file next
                uri = path.resolve().as_uri() + "?mode=rw"
                self._database = sqlite3.connect(uri, uri=True, isolation_level=None, timeout=LOCK_TIMEOUT_S)
                self._database.execute("PRAGMA query_only = ON")
            self._check_schema()

    def _create(self) -> None:
        self._database.execute("PRAGMA synchronous = FULL")
        with self.transaction():
            if not self._database.execute("SELECT 1 FROM sqlite_master").fetchone():
                for statement in split_statements(_SCHEMA):
                    self._database.execute(statement)

    def _check_schema(self) -> None:
        rows = self._database.execute("SELECT value FROM meta WHERE key = 'schema_version'").fetchall()
        version = rows[0][0] if rows else "none"
        if version != str(SCHEMA_VERSION):
            raise ConfigurationError(
                "knowledge schema_version",
                got=version,
                allowed=str(SCHEMA_VERSION),
                fix=f"Update dualbrain. {self.path}",
            )

    @contextmanager
    def _translate_errors(self) -> Generator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            if "fts5" in str(error):
                raise MissingDependencyError(
                    "FTS5 in this Python's SQLite", fix="Use a Python whose SQLite has it."
                ) from error
            if "locked" in str(error):
                raise StoreInUseError(str(self.path), LOCK_TIMEOUT_S) from error
            if "no such table" in str(error) or "malformed" in str(error):
                raise CorruptStoreError(str(error), str(self.path)) from error
            allowed = "a file that this user can read and write, on a disk with space"
            raise ConfigurationError("knowledge store", got=str(error), allowed=allowed, fix=str(self.path)) from error
        except sqlite3.DatabaseError as error:
            raise CorruptStoreError(str(error), str(self.path)) from error

    @contextmanager
    def transaction(self) -> Generator[None]:
        """All that is done inside is written, or nothing of it."""
        with self._translate_errors(), transaction(self._database):
            yield

    # --- what stands there --------------------------------------------------------------------------------------

    def documents(self) -> dict[str, Document]:
        """What stands on the shelf now, by name."""
        last = "SELECT name, document FROM event WHERE seq IN (SELECT max(seq) FROM event GROUP BY name) ORDER BY name"
        return {name: _decode_document(data) for name, data in self._fetch_rows(last) if data is not None}

    def history(self, name: str) -> tuple[tuple[float, Document | None], ...]:
        """When each version of `name` was put up, and when it was taken down (None), oldest first."""
        rows = self._fetch_rows("SELECT time, document FROM event WHERE name = ? ORDER BY seq", (name,))
        return tuple((time, None if data is None else _decode_document(data)) for time, data in rows)

    def chunks(self) -> tuple[StoredChunk, ...]:
        """All chunks of what stands on the shelf."""
        found: list[StoredChunk] = []
        for document in self.documents().values():
            text = self.document_texts(document.name, document.version)[0].text
            for number, chunk in self._chunks_by_id(document.name, document.version):
                found.append(StoredChunk(number, document, chunk, text[chunk.start : chunk.end]))
        return tuple(found)

    def stored_chunks(self, name: str, version: str) -> tuple[Chunk, ...]:
        """The chunks that are kept of a version, none if it is not kept."""
        return tuple(chunk for _, chunk in self._chunks_by_id(name, version))

    def _chunks_by_id(self, name: str, version: str) -> list[tuple[int, Chunk]]:
        query = "SELECT id, start, stop, page, path FROM chunk WHERE name = ? AND version = ? ORDER BY id"
        return [
            (number, Chunk(start, stop, page, tuple(msgspec.json.decode(path, type=list[str]))))
            for number, start, stop, page, path in self._fetch_rows(query, (name, version))
        ]

    def document_texts(self, name: str, version: str) -> tuple[DocumentText, ...]:
        """The readings of `name` whose version begins with `version`, also of what was taken down."""
        query = "SELECT data FROM reading WHERE name = ? AND substr(version, 1, ?) = ?"
        rows = self._fetch_rows(query, (name, len(version), version))
        return tuple(msgspec.json.decode(data, type=DocumentText) for (data,) in rows)

    def vectors(self) -> dict[int, bytes]:
        """The vectors of the chunks that stand there, by number."""
        return dict(self._fetch_rows("SELECT chunk, data FROM vector"))

    def embedder(self) -> str:
        """Who made the vectors, "" if there are none."""
        rows = self._fetch_rows("SELECT value FROM meta WHERE key = 'embedder'")
        return rows[0][0] if rows else ""

    def search_words(self, query: str, limit: int) -> dict[int, float]:
        """BM25 of the chunks that hold a word of `query` (FTS5 syntax), higher is better, best first."""
        found = (
            "SELECT rowid, -bm25(words, 1.5, 1.0) AS score FROM words WHERE words MATCH ? ORDER BY score DESC, rowid"
        )
        return dict(self._fetch_rows(f"{found} LIMIT {int(limit)}", (query,)))

    def _fetch_rows(self, query: str, values: Sequence[object] = ()) -> list[Any]:
        with self._translate_errors():
            return self._database.execute(query, values).fetchall()

    # --- what changes; inside `transaction` ---------------------------------------------------------------------

    def publish(self, document: Document, *, now: float) -> None:
        """Write that this version stands on the shelf from `now` on."""
        self._append_event(document.name, msgspec.json.encode(document), now)

    def withdraw(self, name: str, *, now: float) -> None:
        """Write that `name` no longer stands there."""
        self._append_event(name, None, now)

    def _append_event(self, name: str, document: bytes | None, now: float) -> None:
        self._database.execute("INSERT INTO event (time, name, document) VALUES (?, ?, ?)", (now, name, document))

    def store_text(self, name: str, reading: DocumentText, pieces: Iterable[Chunk]) -> tuple[int, ...]:
        """Keep the reading of a version and its chunks for ever, if they are not kept already; their numbers."""
        if not self.document_texts(name, reading.version):
            insert = "INSERT INTO reading VALUES (?, ?, ?)"
            self._database.execute(insert, (name, reading.version, msgspec.json.encode(reading)))
            self._database.executemany(
                "INSERT INTO chunk (name, version, start, stop, page, path) VALUES (?, ?, ?, ?, ?, ?)",
                [(name, reading.version, c.start, c.end, c.page, msgspec.json.encode(c.path).decode()) for c in pieces],
            )
        rows = self._fetch_rows(
            "SELECT id FROM chunk WHERE name = ? AND version = ? ORDER BY id", (name, reading.version)
        )
        return tuple(number for (number,) in rows)

    def update_projections(self, embedder: str, vectors: Mapping[int, NDArray[np.float32]]) -> None:
        """Make words and vectors those of what stands there; `vectors` are those of chunks that had none."""
        live = {one.id: one for one in self.chunks()}
        indexed = {number for (number,) in self._fetch_rows("SELECT rowid FROM words")}
        gone = [(number,) for number in indexed - live.keys()]
        self._database.executemany("DELETE FROM words WHERE rowid = ?", gone)
        self._database.executemany("DELETE FROM vector WHERE chunk = ?", gone)
        fresh = [live[number] for number in sorted(live.keys() - indexed)]
        rows = [(one.id, " ".join((one.document.title, *one.chunk.path)), one.text) for one in fresh]
        self._database.executemany("INSERT INTO words (rowid, path, text) VALUES (?, ?, ?)", rows)
        stored = [(number, row.astype("<f4").tobytes()) for number, row in vectors.items()]
        self._database.executemany("INSERT OR REPLACE INTO vector VALUES (?, ?)", stored)
        self._database.execute("INSERT OR REPLACE INTO meta VALUES ('embedder', ?)", (embedder,))

    def clear_projections(self) -> None:
        """Empty words and vectors."""
        self._database.execute("DELETE FROM words")
        self._database.execute("DELETE FROM vector")

    def close(self) -> None:
        """Close the file."""
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        self.close()


def _decode_document(data: bytes) -> Document:
    return msgspec.json.decode(data, type=Document)
