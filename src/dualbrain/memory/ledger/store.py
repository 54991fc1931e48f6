"""The storage behind a ledger: events with typed queries, appends after a known head, and a projection of vectors.

A store keeps the events and their hashes as they are given. A SQLite file (`sqlite.store`) and a PostgreSQL database
(`postgres.store`) store the same events with the same hashes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from dualbrain.errors import ConfigurationError, DualbrainError
from dualbrain.memory.ledger.hash_chain import Head, LedgerEvent
from dualbrain.memory.ledger.vectors import StoredVector

COLUMNS = "seq, kind, run, subject, time, payload, previous, hash"
"""Columns of the event table, in the order of the fields of `LedgerEvent`."""
VectorRow = tuple[object, object, object]
"""Version, data and mask of a vector as they were found, before any check."""
ChainedEvent = tuple[LedgerEvent, StoredVector | None]
"""An event with its place in the chain, and the vector of an episode."""
EventBuilder = Callable[[Head], Sequence[ChainedEvent]]
"""Chains events to a head. A store calls it inside its transaction, with the head that no other writer can move."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EventQuery:
    """Conditions on events; an empty tuple or None sets no condition. `after` < seq ≤ `until`."""

    kinds: tuple[str, ...] = ()
    subject: str | None = None
    run: str | None = None
    after: int = 0
    until: int | None = None

    def condition(self) -> tuple[str, list[object]]:
        """The SQL condition with a question mark for each of the values, which are returned, too."""
        terms, values = ["seq > ?"], list[object]([self.after])
        if self.kinds:
            terms.append(f"kind IN ({', '.join('?' * len(self.kinds))})")
            values += self.kinds
        for term, value in (("subject = ?", self.subject), ("run = ?", self.run), ("seq <= ?", self.until)):
            if value is not None:
                terms.append(term)
                values.append(value)
        return " AND ".join(terms), values


class HeadMovedError(DualbrainError):
    """Another writer appended events after the head from which these events were computed; nothing was appended."""

    def __init__(self, expected: Head, found: Head) -> None:
        """Report the head that the writer knew, and the head that was found."""
        self.expected, self.found = expected, found
        super().__init__(
            f"Another writer of the shared memory ledger was faster: its newest event is {found.seq}, not "
            f"{expected.seq}. Nothing was changed. Try again."
        )


class RefusedEntryError(ConfigurationError):
    """An event that this ledger can never take: its name exists already, or it names memories that are not in it."""


class ServerUnreachableError(DualbrainError):
    """The server of a shared ledger does not answer, or refuses the login or the access to its tables for the present.

    `attempted` is the first event of an append whose result is unknown; None if nothing was sent.
    """

    def __init__(
        self, reason: str, *, login_refused: bool = False, access_refused: bool = False, without_attempt: bool = False
    ) -> None:
        """Report the `reason` that the network or the server gives, or gave a moment ago (`without_attempt`)."""
        self.reason, self.without_attempt = reason, without_attempt
        self.login_refused, self.access_refused = login_refused, access_refused
        self.attempted: Head | None = None
        fault, remedy = "does not answer", "Check the network and the url in the file of the ledger, and try again."
        if login_refused:
            fault = "refuses the login"
            remedy = "Check the role in the url, and its password in ~/.pgpass (mode 0600) or the file of PGPASSFILE."
        elif access_refused:
            fault = "refuses the access"
            remedy = "Check the grants of the role in the url, and whether the server is read-only."
        when = " (a moment ago)" if without_attempt else ""
        super().__init__(f"The server of the shared memory ledger {fault}: {reason}{when}. {remedy}")


class LedgerStore(Protocol):
    """Storage of one ledger. Errors are those of `LedgerReader` and `Ledger`."""

    schema: int
    """Version of the tables."""
    missing_objects: tuple[str, ...]
    """Declared indices and triggers that are missing."""

    def events(self, query: EventQuery) -> Iterator[LedgerEvent]:
        """The events that meet `query`, in the order of `seq`."""
        ...

    def head(self) -> Head:
        """Number and hash of the newest event; (0, `GENESIS`) in an empty ledger."""
        ...

    def last_seq_before(self, time: float) -> int:
        """Number of the last event written at or before `time` [s, 1970 UTC]; 0 if there is none."""
        ...

    def vector_rows(self, after: int) -> Iterator[tuple[int, VectorRow]]:
        """Event number and unchecked vector of each episode after event `after`."""
        ...

    def selected_vector_rows(self, seqs: Sequence[int]) -> Iterator[tuple[int, VectorRow, bytes]]:
        """Event number, unchecked vector and payload of each episode in `seqs` that has a vector, in their order."""
        ...

    def append(self, build: EventBuilder, *, after: Head | None = None) -> tuple[LedgerEvent, ...]:
        """Append the events that `build` chains to the head, all or none, durably.

        Raises `HeadMovedError` if `after` is given and is not the head.
        """
        ...

    def replace_vectors(self, vectors: Mapping[int, StoredVector], build: EventBuilder) -> None:
        """Replace the whole projection by `vectors`, and append the events with their digests, all or none."""
        ...

    def find_faults(self) -> tuple[str, ...]:
        """Faults in the structure of the storage."""
        ...

    def close(self) -> None:
        """Close the storage."""
        ...
