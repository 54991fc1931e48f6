"""The document store: one SQLite database with append-only versions, from which the published documents are derived.

An event publishes a version of a document or withdraws the document; the last event of a document determines its state.
Document texts and chunks are never changed or removed, so that every citation stays valid. The words (FTS5) and vectors
of the published documents are projections and can be rebuilt.
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

from dualbrain.core.storage.private_files import create_private_folder, open_private
from dualbrain.core.storage.sqlite import split_statements, transaction
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.knowledge.chunking import Chunk
from dualbrain.knowledge.document import Document
from dualbrain.knowledge.readers.reader import DocumentText
from dualbrain.knowledge.rejection import CorruptStoreError, StoreInUseError

SCHEMA_VERSION = 1
LOCK_TIMEOUT_S = 10.0
"""Time that a writer waits for another writer [s]."""

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
    """A chunk of a published document: its number `id`, the document, the chunk and its text."""

    id: int
    document: Document
    chunk: Chunk
    text: str


class DocumentStore:
    """Reads and, with `write`, changes the file. Transactions are atomic, also if the process is killed.

    SQLite's lock allows one writer at a time. With a rollback journal instead of a WAL the store is a single file when
    it is not being written, which can also be read in a folder without write permission.
    """

    def __init__(self, path: Path, *, write: bool) -> None:
        """Open the file; with `write`, create it if it is missing.

        Raises `MissingDependencyError` if the file or FTS5 is missing, `ConfigurationError` if the file cannot be used,
        `StoreInUseError` if another process keeps writing it, and `CorruptStoreError` if it is damaged.
        """
        if not write and not path.exists():
            raise MissingDependencyError(
                f"The knowledge store {path}", fix="The first `dualbrain knowledge add` creates it."
            )
        self.path = path
        with self._translate_errors():
            if write:
                create_private_folder(path.parent)
                open_private(path, "ab").close()
                self._database = sqlite3.connect(path, isolation_level=None, timeout=LOCK_TIMEOUT_S)
                self._create()
            else:
                # not mode=ro: an unfinished transaction of a killed writer is rolled back by the next process
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
                    "The extension FTS5 of SQLite", fix="Use a Python whose SQLite includes it."
                ) from error
            if "locked" in str(error):
                raise StoreInUseError(str(self.path), LOCK_TIMEOUT_S) from error
            if "no such table" in str(error) or "malformed" in str(error):
                raise CorruptStoreError(str(error), str(self.path)) from error
            fix = "Check that this user can read and write the file, and that the disk has free space."
            sentence = f"The knowledge store {self.path} cannot be used: {error}."
            raise ConfigurationError.stating(sentence, fix=fix) from error
        except sqlite3.DatabaseError as error:
            raise CorruptStoreError(str(error), str(self.path)) from error

    @contextmanager
    def transaction(self) -> Generator[None]:
        """A transaction: all changes inside are written, or none."""
        with self._translate_errors(), transaction(self._database):
            yield

    # --- read ---------------------------------------------------------------------------------------------------

    def documents(self) -> dict[str, Document]:
        """The published documents by name, in the order of their names."""
        last = "SELECT name, document FROM event WHERE seq IN (SELECT max(seq) FROM event GROUP BY name) ORDER BY name"
        return {name: _decode_document(data) for name, data in self._fetch_rows(last) if data is not None}

    def history(self, name: str) -> tuple[tuple[float, Document | None], ...]:
        """Time [s, 1970 UTC] and document of each publication of `name`, None for a withdrawal; oldest first."""
        rows = self._fetch_rows("SELECT time, document FROM event WHERE name = ? ORDER BY seq", (name,))
        return tuple((time, None if data is None else _decode_document(data)) for time, data in rows)

    def chunks(self) -> tuple[StoredChunk, ...]:
        """All chunks of the published documents."""
        chunks: list[StoredChunk] = []
        for document in self.documents().values():
            text = self.document_texts(document.name, document.version)[0].text
            for number, chunk in self._chunks_by_id(document.name, document.version):
                chunks.append(StoredChunk(number, document, chunk, text[chunk.start : chunk.end]))
        return tuple(chunks)

    def stored_chunks(self, name: str, version: str) -> tuple[Chunk, ...]:
        """The stored chunks of a version; none if the version is not stored."""
        return tuple(chunk for _, chunk in self._chunks_by_id(name, version))

    def _chunks_by_id(self, name: str, version: str) -> list[tuple[int, Chunk]]:
        query = "SELECT id, start, stop, page, path FROM chunk WHERE name = ? AND version = ? ORDER BY id"
        return [
            (number, Chunk(start, stop, page, tuple(msgspec.json.decode(path, type=list[str]))))
            for number, start, stop, page, path in self._fetch_rows(query, (name, version))
        ]

    def document_texts(self, name: str, version: str) -> tuple[DocumentText, ...]:
        """The texts of `name` whose version begins with `version`, also those of withdrawn documents."""
        query = "SELECT data FROM reading WHERE name = ? AND substr(version, 1, ?) = ?"
        rows = self._fetch_rows(query, (name, len(version), version))
        return tuple(msgspec.json.decode(data, type=DocumentText) for (data,) in rows)

    def vectors(self) -> dict[int, bytes]:
        """The vectors of the chunks of published documents, by chunk number; little-endian float32."""
        return dict(self._fetch_rows("SELECT chunk, data FROM vector"))

    def embedder(self) -> str:
        """Identity of the encoder of the vectors; "" without vectors."""
        rows = self._fetch_rows("SELECT value FROM meta WHERE key = 'embedder'")
        return rows[0][0] if rows else ""

    def search_words(self, query: str, limit: int) -> dict[int, float]:
        """BM25 score of the chunks that contain a word of `query` (FTS5 syntax); higher is better, best first."""
        ranking = (
            "SELECT rowid, -bm25(words, 1.5, 1.0) AS score FROM words WHERE words MATCH ? ORDER BY score DESC, rowid"
        )
        return dict(self._fetch_rows(f"{ranking} LIMIT {int(limit)}", (query,)))

    def _fetch_rows(self, query: str, values: Sequence[object] = ()) -> list[Any]:
        with self._translate_errors():
            return self._database.execute(query, values).fetchall()

    # --- change, inside `transaction` ---------------------------------------------------------------------------

    def publish(self, document: Document, *, now: float) -> None:
        """Publish this version of a document at `now` [s, 1970 UTC]."""
        self._append_event(document.name, msgspec.json.encode(document), now)

    def withdraw(self, name: str, *, now: float) -> None:
        """Withdraw the document `name` at `now` [s, 1970 UTC]."""
        self._append_event(name, None, now)

    def _append_event(self, name: str, document: bytes | None, now: float) -> None:
        self._database.execute("INSERT INTO event (time, name, document) VALUES (?, ?, ?)", (now, name, document))

    def store_text(self, name: str, document_text: DocumentText, pieces: Iterable[Chunk]) -> tuple[int, ...]:
        """Store the text of a version and its chunks permanently, unless they are stored; returns the chunk numbers."""
        if not self.document_texts(name, document_text.version):
            insert = "INSERT INTO reading VALUES (?, ?, ?)"
            self._database.execute(insert, (name, document_text.version, msgspec.json.encode(document_text)))
            self._database.executemany(
                "INSERT INTO chunk (name, version, start, stop, page, path) VALUES (?, ?, ?, ?, ?, ?)",
                [
                    (name, document_text.version, c.start, c.end, c.page, msgspec.json.encode(c.path).decode())
                    for c in pieces
                ],
            )
        rows = self._fetch_rows(
            "SELECT id FROM chunk WHERE name = ? AND version = ? ORDER BY id", (name, document_text.version)
        )
        return tuple(number for (number,) in rows)

    def update_projections(self, embedder: str, vectors: Mapping[int, NDArray[np.float32]]) -> None:
        """Update words and vectors to the published documents.

        `vectors` are those of the chunks that are new or have a new title, by number.
        """
        published = {one.id: one for one in self.chunks()}
        indexed = {number for (number,) in self._fetch_rows("SELECT rowid FROM words")}
        outdated = indexed - (published.keys() - vectors.keys())
        removed = [(number,) for number in outdated]
        self._database.executemany("DELETE FROM words WHERE rowid = ?", removed)
        self._database.executemany("DELETE FROM vector WHERE chunk = ?", removed)
        added = [published[number] for number in sorted(published.keys() - (indexed - outdated))]
        rows = [(one.id, " ".join((one.document.title, *one.chunk.path)), one.text) for one in added]
        self._database.executemany("INSERT INTO words (rowid, path, text) VALUES (?, ?, ?)", rows)
        stored = [(number, row.astype("<f4").tobytes()) for number, row in vectors.items()]
        self._database.executemany("INSERT OR REPLACE INTO vector VALUES (?, ?)", stored)
        self._database.execute("INSERT OR REPLACE INTO meta VALUES ('embedder', ?)", (embedder,))

    def clear_projections(self) -> None:
        """Delete all words and vectors."""
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
