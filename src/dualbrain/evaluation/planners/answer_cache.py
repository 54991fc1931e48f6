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

from dualbrain.core.storage.atomic_files import write_durably
from dualbrain.errors import UNREADABLE, DualbrainError
from dualbrain.planner.protocol import Planner, answered, propose_all
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal


class Kept(msgspec.Struct, frozen=True):
    """One file of the folder: who was asked, under which hash of the question, and what came."""

    planner: str
    question: str
    proposal: Proposal


class Accident(DualbrainError):
    """A question got no answer: the engine broke, or time ran out. That says nothing of who was asked."""


def is_accident(proposal: Proposal) -> bool:
    """Whether `proposal` stands for a crash, a timeout or a server's error, and not for an answer or a refusal."""
    return not answered(proposal)


def refuse_accident(proposal: Proposal) -> None:
    """Raise `Accident` if `proposal` is the mark of one."""
    if is_accident(proposal):
        raise Accident(f"{proposal.planner} gave no answer: {proposal.finish_reason}")


class Plans:
    """A folder of answers; many processes may use it at once, and none leaves half a file."""

    def __init__(self, folder: Path) -> None:
        """Use `folder`; it is made by the first answer."""
        self.folder = folder

    def find(self, planner: str, request: PlanRequest) -> Proposal | None:
        """The answer that was kept, if there is one; a damaged one is none, and is asked for again."""
        kept = _read(self._path(planner, request))
        return kept.proposal if kept else None

    def keep(self, planner: str, request: PlanRequest, proposal: Proposal) -> None:
        """Keep `proposal`, unless it is the mark of an accident: that is asked again."""
        if is_accident(proposal):
            return
        path = self._path(planner, request)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_durably(path, msgspec.json.encode(Kept(planner, path.stem, proposal)))

    def all(self, left_out: Callable[[str], None] = lambda told: None) -> list[Kept]:
        """Every answer, by hash of its question; `left_out` is told of each file that holds none."""
        files = sorted(self.folder.glob("*.json")) if self.folder.is_dir() else []
        read = [(file, _read(file)) for file in files]
        for file, kept in read:
            if kept is None:
                left_out(f"The answer in {file.parent.name}/{file.name}, which is damaged.")
        return [kept for _, kept in read if kept is not None]

    def _path(self, planner: str, request: PlanRequest) -> Path:
        return self.folder / f"{question_hash(planner, request)}.json"


def _read(path: Path) -> Kept | None:
    """What is kept at `path`, None where nothing is or what is there cannot be read."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=Kept)
    except (FileNotFoundError, *UNREADABLE):
        return None


def question_hash(planner: str, request: PlanRequest) -> str:
    """32 hex digits of the SHA-256 over the planner's id and everything that it is asked."""
    asked = json.dumps([planner, msgspec.to_builtins(request)], sort_keys=True)
    return hashlib.sha256(asked.encode()).hexdigest()[:32]


class KeepingPlanner:
    """Answers from `plans` where it can; else asks the planner that `open_it` opens, and keeps the answer.

    `asked` counts the questions that were really asked. The planner is opened by the first of them.
    """

    def __init__(self, id: str, plans: Plans, open_it: Callable[[], Planner]) -> None:
        """`id` names the planner in the keys: its name, and what else makes it answer as it does."""
        self.id, self.asked = id, 0
        self._plans, self._open = plans, open_it
        self._planner: Planner | None = None

    @property
    def name(self) -> str:
        """The planner's id."""
        return self.id

    def propose(self, request: PlanRequest) -> Proposal:
        """The kept answer, or a fresh one."""
        return self._plans.find(self.id, request) or self.fill([request])[0]

    def fill(self, requests: Sequence[PlanRequest]) -> list[Proposal]:
        """Ask `requests` afresh, side by side where the planner can do that, and keep the answers."""
        self._planner = self._planner or self._open()
        self.asked += len(requests)
        proposals = propose_all(self._planner, requests)
        for request, proposal in zip(requests, proposals, strict=True):
            self._plans.keep(self.id, request, proposal)
        return proposals

    def knows(self, request: PlanRequest) -> bool:
        """Whether the answer was kept."""
        return self._plans.find(self.id, request) is not None

    def close(self) -> None:
        """Close the planner if it was opened."""
        if self._planner is not None:
            self._planner.close()
            self._planner = None
