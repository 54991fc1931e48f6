"""A candidate in the champion's shadow: asked what the champion is asked, heard by nobody, written down.

Its answers move nothing; they tell how it does on real questions before it is promoted. The robot never waits for it: a
question that comes while it still thinks is passed over and counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from threading import Lock, Thread

import msgspec

from dualbrain.adaptation.adapters.card import TORCH_SUFFIX, AdapterCard
from dualbrain.errors import DECODE_ERRORS, ConfigurationError
from dualbrain.planner.introspection import planner_messages, planner_template
from dualbrain.planner.prompt.full_prompt import ChatMessage
from dualbrain.planner.protocol import ERROR, STOP, Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal

JOIN_TIMEOUT_S = 2.0
"""How long an answer under way is waited for at the end [s]; what came of it by then is written down."""


class ShadowRecord(msgspec.Struct, frozen=True, kw_only=True):
    """One question in the shadow: who answered it for good, and what the candidate would have said.

    `passed_over` counts the questions that came meanwhile, or of which nothing could be written.
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
        """Whether both answered alike."""
        return self.finish == STOP and self.candidate_text == self.served_text


class ShadowedPlanner:
    """Proposes with `serving`; `candidate` is asked afterwards, and what it says goes to `log`, one line each."""

    def __init__(self, serving: Planner, candidate: Planner, log: Path) -> None:
        """Let `candidate` stand in the shadow of `serving`; raises `InvalidSetup` if `log` cannot be written."""
        self.serving, self._candidate, self._log = serving, candidate, log
        self._thread: Thread | None = None
        self._lock, self._busy, self._passed_over = Lock(), False, 0
        try:
            log.parent.mkdir(parents=True, exist_ok=True)
            log.open("ab").close()
        except OSError as error:
            raise ConfigurationError("log of the shadow", got=str(error), allowed="a file to write to") from error

    @property
    def name(self) -> str:
        """Who answers."""
        return self.serving.name

    @property
    def template(self) -> str:
        """Hash of the fixed text of the prompt that who answers reads."""
        return planner_template(self.serving)

    @property
    def card(self) -> AdapterCard | None:
        """The adapter of who answers, None for one without."""
        return getattr(self.serving, "card", None)

    def messages(self, request: PlanRequest) -> Sequence[ChatMessage]:
        """What who answers reads for `request`."""
        return planner_messages(self.serving, request)

    def propose(self, request: PlanRequest) -> Proposal:
        """The answer of who serves; nothing waits for the shadow."""
        proposal = self.serving.propose(request)
        if self._try_begin():
            self._thread = Thread(target=self._ask_candidate, args=(request, proposal), name="shadow", daemon=True)
            self._thread.start()
        return proposal

    def close(self) -> None:
        """End both; an answer of the candidate that is under way has a short while left."""
        self._join()
        self.serving.close()
        self._candidate.close()
        self._join()

    def _join(self) -> None:
        if self._thread is not None:
            self._thread.join(JOIN_TIMEOUT_S)

    def _try_begin(self) -> bool:
        """Whether the candidate is free for a question; one that it is not free for is counted."""
        with self._lock:
            free, self._busy = not self._busy, True
            self._passed_over += not free
        return free

    def _end(self) -> int:
        """Set the candidate free; the number of questions that were passed over until now."""
        with self._lock:
            passed_over, self._passed_over, self._busy = self._passed_over, 0, False
        return passed_over

    def _ask_candidate(self, request: PlanRequest, served: Proposal) -> None:
        said = self._candidate_proposal(request)
        glance = ShadowRecord(
            served=served.planner,
            candidate=said.planner,
            instruction=request.instruction,
            served_text=served.text,
            candidate_text=said.text,
            finish=said.finish_reason,
            seconds=said.timings.get("total", 0.0),
            passed_over=self._end(),
        )
        try:
            with self._log.open("ab") as log:
                log.write(msgspec.json.encode(glance) + b"\n")
        except OSError:
            with self._lock:
                self._passed_over += 1 + glance.passed_over

    def _candidate_proposal(self, request: PlanRequest) -> Proposal:
        """What the candidate says; whatever it raises is its finish reason."""
        try:
            return self._candidate.propose(request)
        except Exception as error:
            return Proposal(
                text="", finish_reason=f"{ERROR}: {error}", planner=self._candidate.name, constrained_by="", timings={}
            )


def read_shadow_log(log: Path) -> tuple[ShadowRecord, ...]:
    """What was written down; a last line that a crash cut off never happened.

    Raises `InvalidSetup` for any other line that cannot be read.
    """
    if not log.is_file():
        return ()
    *lines, _torn = log.read_bytes().split(b"\n")
    try:
        return tuple(msgspec.json.decode(line, type=ShadowRecord) for line in lines)
    except DECODE_ERRORS as error:
        raise ConfigurationError(
            "log of the shadow", got=str(error), allowed="as it was written", fix=str(log)
        ) from error


def count_complete(seen: Sequence[ShadowRecord]) -> int:
    """How many answers came to their end."""
    return sum(one.finish == STOP for one in seen)


def filter_by_serving(seen: Sequence[ShadowRecord], serves: Callable[[str], bool]) -> tuple[ShadowRecord, ...]:
    """Those in the shadow of who `serves`, an author as proposals name it, in whatever runtime."""
    return tuple(one for one in seen if serves(one.served.removesuffix(TORCH_SUFFIX)))


def summarize_shadow(seen: tuple[ShadowRecord, ...]) -> str:
    """How a candidate did in the shadow, in words."""
    if not seen:
        return "never asked in the shadow"
    same, errors = sum(one.is_same for one in seen), sum(one.finish.startswith(ERROR) for one in seen)
    passed_over = sum(one.passed_over for one in seen)
    told = (
        f"asked {len(seen)} times in the shadow: {count_complete(seen)} whole answers, {same} as who served, "
        f"{median([one.seconds for one in seen if one.seconds] or [0.0]):.1f} s each (median)"
    )
    if errors:
        told += f"; errors: {errors}"
    if passed_over:
        told += f"; {passed_over} more passed over, while it still thought or nothing could be written"
    return told
