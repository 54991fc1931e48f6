"""Rejection of a document, which is a value because bad documents are expected, and errors of the store."""

from __future__ import annotations

import msgspec

from dualbrain.errors import DualbrainError


class DocumentRejected(msgspec.Struct, frozen=True):
    """Reason for a rejection: the property `what`, the value `got`, the values `allowed`, and the remedy `fix`."""

    what: str
    got: str
    allowed: str
    fix: str = ""

    def __str__(self) -> str:
        return f"{self.what}: got {self.got}; allowed: {self.allowed}." + (f" {self.fix}" if self.fix else "")


class StoreInUseError(DualbrainError):
    """Another process is writing the knowledge store."""

    def __init__(self, path: str, timeout_s: float) -> None:
        """Report the path of the store and the time that the writer waited [s]."""
        self.path, self.timeout_s = path, timeout_s
        super().__init__(
            f"Another process has been writing the knowledge store for more than {timeout_s:g} s. Only one process can "
            f"write at a time: try again when it has finished. Reading is always possible. {path}"
        )


class CorruptStoreError(DualbrainError):
    """The file is damaged or is not a knowledge store."""

    def __init__(self, why: str, path: str) -> None:
        """Report the fault and, last, the path of the file."""
        self.path = path
        super().__init__(
            f"The knowledge store is damaged: {why}. Move it away and add your documents again; the built-in ones are "
            f"added automatically. {path}"
        )
