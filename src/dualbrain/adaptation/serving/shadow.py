"""Shadow mode: a candidate receives the questions of the serving planner, and its answers are only logged.

The answers never reach a robot; they show how the candidate performs on real questions before a promotion. The robot
never waits for the candidate: a question that arrives while it is busy is skipped and counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from threading import Lock, Thread

import msgspec

from dualbrain.adaptation.adapters.card import TORCH_SUFFIX, AdapterCard
from dualbrain.core.storage.file_lock import file_lock
from dualbrain.core.storage.private_files import create_private_folder, open_private
from dualbrain.core.text import make_json_safe
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.planner.introspection import planner_messages, planner_template, takes_images
from dualbrain.planner.prompt.full_prompt import ChatMessage
from dualbrain.planner.protocol import ERROR, STOP, Planner, show_answers
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal

JOIN_TIMEOUT_S = 2.0
"""Longest wait for a pending answer at the end [s]; the answer is logged if it arrives by then."""


class ShadowRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One shadow question: the serving planner with its answer, and the answer of the candidate.

    `finish` is the candidate's finish reason, `seconds` [s] its time. `passed_over` counts the questions since the last
    record that were skipped or could not be logged.
    """

    served: str
    candidate: str
    instruction: str
    served_text: str
    candidate_text: str
    finish: str
    seconds: float
    passed_over: int = 0

    @property
    def is_same(self) -> bool:
        """Whether both answers are equal."""
        return self.finish == STOP and self.candidate_text == self.served_text


class ShadowedPlanner:
    """Proposes with `serving`; afterwards `candidate` is asked the same, and its answer is appended to `log`."""

    def __init__(self, serving: Planner, candidate: Planner, log: Path) -> None:
        """Run `candidate` in the shadow of `serving`; raises `ConfigurationError` if `log` cannot be written."""
        self.serving, self._candidate, self._log = serving, candidate, log
        self._thread: Thread | None = None
        self._lock, self._busy, self._passed_over = Lock(), False, 0
        try:
            create_private_folder(log.parent)
            open_private(log, "ab").close()
        except OSError as error:
            raise ConfigurationError.stating(f"The shadow log cannot be written: {error}.") from error

    @property
    def name(self) -> str:
        """The name of the serving planner."""
        return self.serving.name

    @property
    def template(self) -> str:
        """Hash of the prompt template of the serving planner."""
        return planner_template(self.serving)

    @property
    def takes_images(self) -> bool:
        """Whether the serving planner takes images; the candidate never sees them."""
        return takes_images(self.serving)

    @property
    def card(self) -> AdapterCard | None:
        """The adapter of the serving planner, None without one."""
        return getattr(self.serving, "card", None)

    def messages(self, request: PlanRequest) -> Sequence[ChatMessage]:
        """The messages that the serving planner receives for `request`."""
        return planner_messages(self.serving, request)

    def propose(self, request: PlanRequest) -> Proposal:
        """The answer of the serving planner; it does not wait for the candidate."""
        proposal = self.serving.propose(request)
        if self._try_begin():
            self._thread = Thread(target=self._ask_candidate, args=(request, proposal), name="shadow", daemon=True)
            self._thread.start()
        return proposal

    def show_answers(self, show: Callable[[str], None]) -> None:
        """Let the serving planner call `show` while it answers."""
        show_answers(self.serving, show)

    def close(self) -> None:
        """Close both planners; a pending answer of the candidate has `JOIN_TIMEOUT_S` left."""
        self._join()
        self.serving.close()
        self._candidate.close()
        self._join()

    def _join(self) -> None:
        if self._thread is not None:
            self._thread.join(JOIN_TIMEOUT_S)

    def _try_begin(self) -> bool:
        """Whether the candidate is free; if it is not, the question is counted as skipped."""
        with self._lock:
            free, self._busy = not self._busy, True
            self._passed_over += not free
        return free

    def _end(self) -> int:
        """Release the candidate and return the number of questions skipped until now."""
        with self._lock:
            passed_over, self._passed_over, self._busy = self._passed_over, 0, False
        return passed_over

    def _ask_candidate(self, request: PlanRequest, served: Proposal) -> None:
        proposal = self._candidate_proposal(request)
        record = ShadowRecord(
            served=served.planner,
            candidate=proposal.planner,
            instruction=request.instruction,
            served_text=served.text,
            candidate_text=proposal.text,
            finish=proposal.finish_reason,
            seconds=proposal.timings.get("total", 0.0),
            passed_over=self._end(),
        )
        try:
            _append_record(self._log, record)
        except OSError:
            with self._lock:
                self._passed_over += 1 + record.passed_over

    def _candidate_proposal(self, request: PlanRequest) -> Proposal:
        """The proposal of the candidate; any exception becomes its finish reason."""
        try:
            return self._candidate.propose(request)
        except Exception as error:
            return Proposal(text="", finish_reason=f"{ERROR}: {error}", planner=self._candidate.name, timings={})


def _append_record(log: Path, record: ShadowRecord) -> None:
    """Append one line; an incomplete last line, left by a crash or a full disk, is cut off first. Raises `OSError`.

    Lone surrogates in a text, which a server may send and JSON cannot contain, become U+FFFD.
    """
    line = msgspec.json.encode(make_json_safe(msgspec.to_builtins(record))) + b"\n"
    with file_lock(log.with_suffix(".lock")), open_private(log, "a+b") as file:
        file.seek(0)
        file.truncate(file.read().rfind(b"\n") + 1)
        file.write(line)


def read_shadow_log(log: Path) -> tuple[ShadowRecord, ...]:
    """The records of the log; an incomplete last line, left by a crash, is ignored.

    Raises `ConfigurationError` for any other unreadable line.
    """
    if not log.is_file():
        return ()
    *lines, _torn = log.read_bytes().split(b"\n")
    try:
        return tuple(msgspec.json.decode(line, type=ShadowRecord) for line in lines)
    except DECODE_ERRORS as error:
        fix = f"Restore it from a backup, or delete it. {log}"
        raise ConfigurationError.stating(f"The shadow log is damaged: {error}.", fix=fix) from error


def count_complete(seen: Sequence[ShadowRecord]) -> int:
    """The number of complete answers."""
    return sum(one.finish == STOP for one in seen)


def filter_by_serving(seen: Sequence[ShadowRecord], serves: Callable[[str], bool]) -> tuple[ShadowRecord, ...]:
    """The records whose serving planner satisfies `serves`; it receives the author's name without the runtime."""
    return tuple(one for one in seen if serves(one.served.removesuffix(TORCH_SUFFIX)))


def summarize_shadow(seen: tuple[ShadowRecord, ...]) -> str:
    """The performance of a candidate in the shadow, in words."""
    if not seen:
        return "no shadow answers"
    same, errors = sum(one.is_same for one in seen), sum(one.finish.startswith(ERROR) for one in seen)
    passed_over = sum(one.passed_over for one in seen)
    summary = (
        f"{len(seen)} shadow answers: {count_complete(seen)} complete, {same} equal to the served answer, "
        f"{median([one.seconds for one in seen if one.seconds] or [0.0]):.1f} s each (median)"
    )
    if errors:
        summary += f"; errors: {errors}"
    if passed_over:
        summary += f"; {passed_over} more questions skipped, because the candidate was busy or the log not writable"
    return summary
