"""Recognition of repeated submissions: a client that submits a contract again does not move the robot again.

A contract is identified by its `id` and by the digest of its content. Within `RETRY_WINDOW`, the same id with the same
content gets the report of the first submission; the same id with another content is rejected. An id whose contract the
gate rejected is free again, because nothing moved. With a file, the contracts that may have moved the robot are known
after a restart of this process as well.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from threading import Lock
from typing import TypeGuard

import msgspec

from dualbrain.agent_api.submission import Submission, SubmissionReport
from dualbrain.contracts.gate.strict_json import parse
from dualbrain.contracts.schema import ID_LENGTH
from dualbrain.contracts.verdict import Rejected
from dualbrain.core.storage.atomic_files import translated_write_errors, write_atomically
from dualbrain.core.storage.jsonl_log import JsonlLog

RETRY_WINDOW = 900.0
"""Time [s] after its submission for which the id of a contract is kept."""
MAX_KNOWN = 4096
"""Number of submissions that are known beyond `RETRY_WINDOW`, for questions about their outcome."""
MAX_ID = 9999
"""Highest number of an id; ids have four digits."""
LOST_REASON = "the process of the agent interface ended while the contract ran; look at the scene"


class _Line(msgspec.Struct, kw_only=True):
    """One line of the file."""

    key: str
    digest: str
    time: float
    report: SubmissionReport | None = None


class RetryLog:
    """The submissions of the last `RETRY_WINDOW`, by the id of the contract. `now` is in [s, 1970 UTC].

    `add` and `finish` wait for the disk and may be called beside every other method; the others need a lock of the
    caller, who holds no lock during `add` and `finish` that anything urgent needs.
    """

    def __init__(self, path: Path | None = None, *, now: float = 0.0) -> None:
        """Keep the submissions in memory and, if a `path` is given, in this file."""
        self._submissions: dict[str, Submission] = {}
        self._last_id = 0
        self._log = JsonlLog(path) if path else None
        self._writing = Lock()  # for the file alone: a slow disk delays nothing else
        if self._log is not None:
            self._read(self._log, now)

    def find(self, contract_id: str, digest: str, now: float) -> Submission | Rejected | None:
        """The earlier submission of this contract, the rejection of an id in use, or None for a new contract."""
        known = self._submissions.get(contract_id)
        if not _is_kept(known, now):
            return None
        if known.digest == digest:
            return known
        return Rejected(
            stage="authorization",
            pointer="/id",
            got=contract_id,
            allowed="an id that was not used in the last 15 minutes",
            hint="another contract has this id; give each new contract a new id",
        )

    def next_id(self, now: float) -> str:
        """An id that no contract has used within the window; the first one is c-0001."""
        for _ in range(MAX_ID):
            self._last_id = self._last_id % MAX_ID + 1
            name = f"c-{self._last_id:04d}"
            if not _is_kept(self._submissions.get(name), now):
                self._last_id -= 1  # until a contract uses the id
                return name
        return "c-0001"  # every id is in use, and the contract will be rejected

    def get(self, contract_id: str) -> Submission | None:
        """The submission with this id; None if it is not known."""
        return self._submissions.get(contract_id)

    def keep(self, contract_id: str, submission: Submission) -> None:
        """Keep a new submission in memory only; `add` follows. The oldest ones beyond the window are forgotten."""
        self._submissions[contract_id] = submission
        if len(self._submissions) > MAX_KNOWN:
            oldest = submission.submitted_at - RETRY_WINDOW
            old = [name for name, one in self._submissions.items() if one.submitted_at < oldest]
            for name in old[: len(self._submissions) - MAX_KNOWN]:
                del self._submissions[name]

    def add(self, contract_id: str, submission: Submission) -> None:
        """Keep a new submission, before it is sent to the robot; raises `FileWriteError`."""
        self.keep(contract_id, submission)
        self._append(contract_id, submission, None)

    def finish(self, contract_id: str, submission: Submission) -> None:
        """Note the end of a submission; raises `FileWriteError`."""
        self._append(contract_id, submission, submission.report)

    def _append(self, contract_id: str, submission: Submission, report: SubmissionReport | None) -> None:
        if self._log is not None:
            line = _Line(key=contract_id, digest=submission.digest, time=submission.submitted_at, report=report)
            with self._writing, translated_write_errors(self._log.path):
                self._log.append(msgspec.to_builtins(line))

    def _read(self, log: JsonlLog, now: float) -> None:
        """Read the submissions within the window, and drop the older ones; one without an end was interrupted."""
        lines = [line for line in log.latest() if _is_recent(line, now)]
        if log.path.exists():
            write_atomically(log.path, b"".join(msgspec.json.encode(line) + b"\n" for line in lines))
        for line in lines:
            one = msgspec.convert(line, type=_Line)
            report = one.report or SubmissionReport(id=one.key, state="lost", reason=LOST_REASON)
            self._submissions[one.key] = Submission(report, one.digest, one.time)


def _is_kept(known: Submission | None, now: float) -> TypeGuard[Submission]:
    """Whether `known` keeps its id from another use."""
    return known is not None and now - known.submitted_at <= RETRY_WINDOW and known.report.state != "rejected"


def _is_recent(line: object, now: float) -> bool:
    try:
        return now - msgspec.convert(line, type=_Line).time <= RETRY_WINDOW
    except msgspec.ValidationError:  # the line of another version
        return False


def contract_identity(data: bytes) -> tuple[str, str]:
    """The id and the digest of the contract in `data`, ("", "") if it has no valid id, so that the gate rejects it.

    An id that is longer than a valid one counts as none, so that ids that are kept are bounded. The digest does not
    depend on white space and the order of keys.
    """
    document = parse(data)
    if not isinstance(document, dict) or not isinstance(document.get("id"), str):
        return "", ""
    if len(document["id"]) > ID_LENGTH:
        return "", ""
    content = json.dumps(document, sort_keys=True, separators=(",", ":")).encode()
    return document["id"], hashlib.sha256(content).hexdigest()
