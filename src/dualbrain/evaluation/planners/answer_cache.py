"""Answers kept by question: the same question to the same planner is asked once, in a pass of its own or in flight.

A kept answer saves time and never enters a latency figure: what is measured of a planner is measured when it is really
asked. Assumption: the planner is deterministic (greedy decoding), as ours are.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.errors import DECODE_ERRORS, DualbrainError
from dualbrain.planner.protocol import Planner, has_answer, propose_all
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal


class CachedAnswer(msgspec.Struct, frozen=True):
    """One file of the folder: who was asked, under which hash of the question, and what came."""

    planner: str
    question: str
    proposal: Proposal


class NoAnswerError(DualbrainError):
    """A question got no answer: the engine broke, or time ran out. That says nothing of who was asked."""


def has_no_answer(proposal: Proposal) -> bool:
    """Whether `proposal` stands for a crash, a timeout or a server's error, and not for an answer or a refusal."""
    return not has_answer(proposal)


def require_answer(proposal: Proposal) -> None:
    """Raise `Accident` if `proposal` is the mark of one."""
    if has_no_answer(proposal):
        raise NoAnswerError(f"{proposal.planner} gave no answer: {proposal.finish_reason}")


class AnswerCache:
    """A folder of answers; many processes may use it at once, and none leaves half a file."""

    def __init__(self, folder: Path) -> None:
        """Use `folder`; it is made by the first answer."""
        self.folder = folder

    def get(self, planner: str, request: PlanRequest) -> Proposal | None:
        """The answer that was kept, if there is one; a damaged one is none, and is asked for again."""
        kept = _read(self._path(planner, request))
        return kept.proposal if kept else None

    def put(self, planner: str, request: PlanRequest, proposal: Proposal) -> None:
        """Keep `proposal`, unless it is the mark of an accident: that is asked again."""
        if has_no_answer(proposal):
            return
        path = self._path(planner, request)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, msgspec.json.encode(CachedAnswer(planner, path.stem, proposal)))

    def read_all(self, on_omission: Callable[[str], None] = lambda told: None) -> list[CachedAnswer]:
        """Every answer, by hash of its question; `left_out` is told of each file that holds none."""
        files = sorted(self.folder.glob("*.json")) if self.folder.is_dir() else []
        read = [(file, _read(file)) for file in files]
        for file, kept in read:
            if kept is None:
                on_omission(f"The answer in {file.parent.name}/{file.name}, which is damaged.")
        return [kept for _, kept in read if kept is not None]

    def _path(self, planner: str, request: PlanRequest) -> Path:
        return self.folder / f"{request_hash(planner, request)}.json"


def _read(path: Path) -> CachedAnswer | None:
    """What is kept at `path`, None where nothing is or what is there cannot be read."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=CachedAnswer)
    except (FileNotFoundError, *DECODE_ERRORS):
        return None


def request_hash(planner: str, request: PlanRequest) -> str:
    """32 hex digits of the SHA-256 over the planner's id and everything that it is asked."""
    asked = json.dumps([planner, msgspec.to_builtins(request)], sort_keys=True)
    return hashlib.sha256(asked.encode()).hexdigest()[:32]


class CachingPlanner:
    """Answers from `plans` where it can; else asks the planner that `open_it` opens, and keeps the answer.

    `asked` counts the questions that were really asked. The planner is opened by the first of them.
    """

    def __init__(self, id: str, cache: AnswerCache, open_planner: Callable[[], Planner]) -> None:
        """`id` names the planner in the keys: its name, and what else makes it answer as it does."""
        self.id, self.n_requests = id, 0
        self._cache, self._open = cache, open_planner
        self._planner: Planner | None = None

    @property
    def name(self) -> str:
        """The planner's id."""
        return self.id

    def propose(self, request: PlanRequest) -> Proposal:
        """The kept answer, or a fresh one."""
        return self._cache.get(self.id, request) or self.propose_uncached([request])[0]

    def propose_uncached(self, requests: Sequence[PlanRequest]) -> list[Proposal]:
        """Ask `requests` afresh, side by side where the planner can do that, and keep the answers."""
        self._planner = self._planner or self._open()
        self.n_requests += len(requests)
        proposals = propose_all(self._planner, requests)
        for request, proposal in zip(requests, proposals, strict=True):
            self._cache.put(self.id, request, proposal)
        return proposals

    def is_cached(self, request: PlanRequest) -> bool:
        """Whether the answer was kept."""
        return self._cache.get(self.id, request) is not None

    def close(self) -> None:
        """Close the planner if it was opened."""
        if self._planner is not None:
            self._planner.close()
            self._planner = None
