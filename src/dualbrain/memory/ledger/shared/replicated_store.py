"""A shared ledger on this machine: a replica in SQLite that follows a PostgreSQL server.

Every read is local. The replica contains only events that the server has committed, so that it can be removed and
copied again. While the server does not answer, reads continue and appends raise `ServerUnreachableError`.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Self

from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.memory.ledger.hash_chain import CorruptLedgerError, Head, LedgerEvent, verified_events
from dualbrain.memory.ledger.shared.config import SharedLedgerConfig, is_shared, read_shared_config
from dualbrain.memory.ledger.sqlite.store import SqliteStore
from dualbrain.memory.ledger.store import EventBuilder, EventQuery, HeadMovedError, ServerUnreachableError, VectorRow
from dualbrain.memory.ledger.vectors import DIGEST_EVENT_KINDS, StoredVector, find_vector_fault, recorded_digests
from dualbrain.memory.ledger.writer_lock import LedgerInUseError, LockHolder, WriterLock

if TYPE_CHECKING:
    from dualbrain.memory.ledger.postgres.store import PostgresStore

RETRY_INTERVAL_S = 10.0
"""After a failed connection, no other is tried for this time [s], so that retrieval does not wait for the network."""


class ReplicatedStore:
    """The replica of the shared ledger that the file at `path` names; see `LedgerStore`."""

    def __init__(self, path: Path, config: SharedLedgerConfig, replica: SqliteStore, *, is_writable: bool) -> None:
        """Read from `replica`; with `is_writable`, it follows the server and is this process's own."""
        self.path, self.config, self.replica, self._is_writable = path, config, replica, is_writable
        self.schema, self.missing_objects = replica.schema, replica.missing_objects
        self._server: PostgresStore | None = None
        self._failed_at = 0.0
        self._failure: ServerUnreachableError | None = None

    @classmethod
    def open_for_writing(cls, path: Path, *, accept_faults: bool = False) -> Self:
        """Open the replica, whose writer lock is held, and copy new events from the server if it answers.

        Raises `ConfigurationError`, `CorruptLedgerError` and, for the first copy, `ServerUnreachableError`.
        """
        config = read_shared_config(path)
        require_postgres()
        is_new = not replica_path(path).exists()
        replica = SqliteStore.open_for_writing(replica_path(path), accept_faults=accept_faults)
        replica.database.execute("PRAGMA synchronous = NORMAL")  # the server has every event of the replica
        store = cls(path, config, replica, is_writable=True)
        try:
            if is_new:
                store.pull()
            else:
                with suppress(ServerUnreachableError):
                    store.pull()
        except BaseException:
            store.close()
            if is_new:
                replica_path(path).unlink(missing_ok=True)
            raise
        return store

    @classmethod
    def open_for_reading(cls, path: Path) -> Self:
        """Open the replica for reading; new events are copied first, unless another process does that."""
        config = read_shared_config(path)
        with suppress(LedgerInUseError, ServerUnreachableError):
            lock = WriterLock(path, LockHolder(0, "a reader of the shared ledger", 0.0))
            try:
                cls.open_for_writing(path).close()
            finally:
                lock.release()
        if not replica_path(path).exists():
            raise MissingDependencyError(
                "The replica of the shared memory ledger",
                fix=f"Its server does not answer yet; the first contact creates the replica. {path}",
            )
        return cls(path, config, SqliteStore.open_for_reading(replica_path(path)), is_writable=False)

    # --- reads are local --------------------------------------------------------------------------------------------

    def events(self, query: EventQuery) -> Iterator[LedgerEvent]:
        """See `LedgerStore`."""
        return self.replica.events(query)

    def head(self) -> Head:
        """See `LedgerStore`."""
        return self.replica.head()

    def last_seq_before(self, time: float) -> int:
        """See `LedgerStore`."""
        return self.replica.last_seq_before(time)

    def vector_rows(self, after: int) -> Iterator[tuple[int, VectorRow]]:
        """See `LedgerStore`."""
        return self.replica.vector_rows(after)

    def selected_vector_rows(self, seqs: Sequence[int]) -> Iterator[tuple[int, VectorRow, bytes]]:
        """See `LedgerStore`."""
        return self.replica.selected_vector_rows(seqs)

    # --- the server -------------------------------------------------------------------------------------------------

    def pull(self) -> int:
        """Copy the events that are new on the server, each after a check of its link and vector; returns their number.

        Raises `ServerUnreachableError`, and `CorruptLedgerError` if they do not continue the replica.
        """
        server, head = self._connected(), self.replica.head()
        with self._noting_failures(), server.snapshot():
            found = server.head()
            if found == head:
                return 0
            self._require_ancestor(server, head, found)
            fresh = verified_events(server.events(EventQuery(after=head.seq)), str(self.path), after=head)
            digests = dict[int, str]()
            self.replica.copy(_noting_digests(fresh, digests), lambda: _changed_vectors(server, digests, self.path))
        return found.seq - head.seq

    def append(self, build: EventBuilder, *, after: Head | None = None) -> tuple[LedgerEvent, ...]:
        """See `LedgerStore`; raises `ServerUnreachableError`, too, with the first event if the result is unknown."""
        head = self.replica.head()
        if after is not None and after != head:
            raise HeadMovedError(after, head)
        server = self._connected()
        with self._noting_failures():
            chained = server.append_chained(build, after=after)
        if chained and chained[0][0].previous == head.hash:
            self.replica.copy(
                (event for event, _ in chained), lambda: [(event.seq, one) for event, one in chained if one is not None]
            )
        elif chained:
            try:
                self.pull()
            except ServerUnreachableError as error:
                first = chained[0][0]
                error.attempted = Head(first.seq, first.hash)
                raise
        return tuple(event for event, _ in chained)

    def replace_vectors(self, vectors: Mapping[int, StoredVector], build: EventBuilder) -> None:
        """See `LedgerStore`."""
        with self._noting_failures():
            self._connected().replace_vectors(vectors, build)
        self.pull()

    @contextmanager
    def exclusive(self) -> Generator[None]:
        """In the body, no other robot can append."""
        with self._noting_failures(), self._connected().exclusive():
            yield

    def find_faults(self) -> tuple[str, ...]:
        """Faults of the replica and of the server, and a server that could not be compared."""
        faults = self.replica.find_faults()
        try:
            require_postgres()
            server = self._connected()
            with server.snapshot():
                with suppress(CorruptLedgerError):
                    faults += server.find_faults()
                head = self.replica.head()
                self._require_ancestor(server, head, server.head())
        except (ServerUnreachableError, CorruptLedgerError, MissingDependencyError) as error:
            faults += (str(error),)
        return faults

    def close(self) -> None:
        """Close the replica and the connection."""
        self.replica.close()
        if self._server is not None:
            self._server.close()

    def _connected(self) -> PostgresStore:
        """The open server; raises `ServerUnreachableError` without a trial shortly after a failure."""
        from dualbrain.memory.ledger.postgres.store import PostgresStore  # noqa: PLC0415  (an optional package)

        if self._server is not None and self._server.is_open:
            return self._server
        if self._failure is not None and time.monotonic() < self._failed_at + RETRY_INTERVAL_S:
            raise ServerUnreachableError(
                self._failure.reason,
                login_refused=self._failure.login_refused,
                access_refused=self._failure.access_refused,
                without_attempt=True,
            )
        with self._noting_failures():
            self._server = PostgresStore.open(self.config.url, self.config.namespace)
        self._failure = None
        return self._server

    @contextmanager
    def _noting_failures(self) -> Generator[None]:
        """Close a connection that fails in the body, and note the time."""
        try:
            yield
        except ServerUnreachableError as error:
            if error.without_attempt:
                raise
            self._failed_at, self._failure = time.monotonic(), error
            if self._server is not None:
                self._server.close()
            self._server = None
            raise

    def _require_ancestor(self, server: PostgresStore, head: Head, found: Head) -> None:
        """Raise `CorruptLedgerError` unless the server has the newest event of the replica."""
        if head.seq == 0:
            return
        same = next(server.events(EventQuery(after=head.seq - 1, until=head.seq)), None)
        if same is None or same.hash != head.hash:
            fault = f"the server ends at event {found.seq} and lacks event {head.seq} of this robot's replica"
            if same is not None:
                fault = f"event {head.seq} on the server is another one than in this robot's replica"
            fix = "Restore the newest backup of the server. If the loss is intended, remove the replica "
            raise CorruptLedgerError(fault, seq=head.seq, path="", fix=f"{fix}{replica_path(self.path)}")


def replica_path(path: Path) -> Path:
    """The replica of the shared ledger that the file at `path` names."""
    return path.with_name(f"{path.name}.sqlite")


def require_postgres() -> None:
    """Raise `MissingDependencyError` if the extra `postgres` is not installed."""
    if find_spec("psycopg") is None:
        fix = "Install it with: pip install 'dualbrain[postgres]'"
        raise MissingDependencyError("The client of PostgreSQL (psycopg)", fix=fix)


def require_local(path: Path, what: str) -> None:
    """Raise `ConfigurationError` if the ledger at `path` is a shared one, for which `what` is not possible."""
    if is_shared(path):
        raise ConfigurationError.stating(f"A shared ledger cannot be {what}. {path}", fix="Use a ledger file.")


def _noting_digests(events: Iterable[LedgerEvent], digests: dict[int, str]) -> Iterator[LedgerEvent]:
    """The same events; the digests of vectors that they record are put into `digests`."""
    for event in events:
        if event.kind in DIGEST_EVENT_KINDS:
            digests.update(recorded_digests([event]))
        yield event


def _changed_vectors(
    server: PostgresStore, digests: Mapping[int, str], path: Path
) -> Iterator[tuple[int, StoredVector | None]]:
    """The vectors with new `digests` on the server; raises `CorruptLedgerError` for one that does not fit."""
    wanted = {seq for seq, digest in digests.items() if digest}
    for seq in digests.keys() - wanted:
        yield seq, None
    if not wanted:
        return
    for seq, row in server.vector_rows(min(wanted) - 1):
        if seq in wanted:
            wanted.discard(seq)
            if fault := find_vector_fault(row, digests[seq]):
                raise CorruptLedgerError(fault, seq=seq, path=str(path))
            yield seq, StoredVector(*row)  # pyright: ignore[reportArgumentType]
    if wanted:
        raise CorruptLedgerError("its vector is missing", seq=min(wanted), path=str(path))
