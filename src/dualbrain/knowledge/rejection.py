"""Why a document is not taken: a value, because a bad document is nothing unusual."""

from __future__ import annotations

import msgspec

from dualbrain.errors import DualbrainError


class DocumentRejected(msgspec.Struct, frozen=True):
    """`what` is wrong, what was `got`, what is `allowed`, and how to `fix` it."""

    what: str
    got: str
    allowed: str
    fix: str = ""

    def __str__(self) -> str:
        return f"{self.what}: got {self.got}; allowed: {self.allowed}." + (f" {self.fix}" if self.fix else "")


class StoreInUseError(DualbrainError):
    """Another process is writing the knowledge store."""

    def __init__(self, path: str, timeout_s: float) -> None:
        """Name the store and how long we waited [s]."""
        self.path, self.timeout_s = path, timeout_s
        super().__init__(
            f"The knowledge store is being written by another process, for more than {timeout_s:g} s. One writer at a "
            f"time: try again when it is done. Reading is always allowed. {path}"
        )


class CorruptStoreError(DualbrainError):
    """The file is no knowledge store, or a broken one."""

    def __init__(self, why: str, path: str) -> None:
        """Say what was found and, last, where."""
        self.path = path
        super().__init__(
            f"The knowledge store is damaged: {why}. Move it away and add your documents again; dualbrain's own come "
            f"back by themselves. {path}"
        )
