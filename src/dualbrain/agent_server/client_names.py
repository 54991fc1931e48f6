"""Names of MCP clients as the authors of contracts: short, printable and few.

The name becomes the source of a memory, and the influence of each source is bounded. A client chooses its name itself,
so the number of names is bounded as well: a client that changes its name does not get a new bound each time.
"""

from __future__ import annotations

from threading import Lock

from dualbrain.core.text import to_printable

MAX_NAMES = 8
"""Number of names that are distinguished; further clients share one name."""
MAX_LENGTH = 40
"""Longest name of a client [characters]."""
PREFIX = "mcp:"
UNNAMED, FURTHER = f"{PREFIX}unnamed", f"{PREFIX}further clients"


class ClientNames:
    """The names that were given so far; every method may be called from any thread."""

    def __init__(self) -> None:
        """Start without names."""
        self._lock, self._known = Lock(), set[str]()

    def name(self, given: str) -> str:
        """The author for a client that names itself `given`."""
        if not given:
            return UNNAMED
        name = f"{PREFIX}{str(to_printable(given))[:MAX_LENGTH]}"
        with self._lock:
            if name in self._known or len(self._known) < MAX_NAMES:
                self._known.add(name)
                return name
        return FURTHER
