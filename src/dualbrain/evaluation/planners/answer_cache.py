"""Cache of planner answers: the same request to the same planner is computed once, in the plan stage or in an episode.

A cached answer saves time and never enters a latency: latencies are taken from computed answers only. Assumption: the
planner is deterministic (greedy decoding), as all built-in planners are.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.errors import DECODE_ERRORS, DualbrainError
from dualbrain.planner.protocol import Planner, has_answer, propose_all
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal


class CachedAnswer(msgspec.Struct, frozen=True):
    """One file of the folder: the planner's id, the hash of the request, and the answer."""

    planner: str
    question: str
    proposal: Proposal


class NoAnswerError(DualbrainError):
    """A request got no answer, because the engine failed or time ran out; independent of the quality of the model."""


def has_no_answer(proposal: Proposal) -> bool:
    """Whether `proposal` represents a crash, a timeout or a server error instead of an answer or a refusal."""
    return not has_answer(proposal)


def require_answer(proposal: Proposal) -> None:
    """Raise `NoAnswerError` if `proposal` contains no answer."""
    if has_no_answer(proposal):
        raise NoAnswerError(f"{proposal.planner} gave no answer: {proposal.finish_reason}")


class AnswerCache:
    """A folder of answers that several processes may use at once; its files are written atomically."""

    def __init__(self, folder: Path) -> None:
        """Use `folder`, which need not exist."""
        self.folder = folder

    def get(self, planner: str, request: PlanRequest) -> Proposal | None:
        """The cached answer, None if there is none; a damaged file counts as none."""
        cached = _read(self._path(planner, request))
        return cached.proposal if cached else None

    def put(self, planner: str, request: PlanRequest, proposal: Proposal) -> None:
        """Store `proposal`, unless it contains no answer: then the request is made again."""
        if has_no_answer(proposal):
            return
        path = self._path(planner, request)
        create_private_folder(self.folder)
        write_atomically(path, msgspec.json.encode(CachedAnswer(planner, path.stem, proposal)))

    def read_all(self, on_omission: Callable[[str], None] = lambda sentence: None) -> list[CachedAnswer]:
        """All answers, ordered by the hash of the request; each damaged file is reported to `on_omission`."""
        files = sorted(self.folder.glob("*.json")) if self.folder.is_dir() else []
        read = [(file, _read(file)) for file in files]
        for file, cached in read:
            if cached is None:
                on_omission(f"The answer in {file.parent.name}/{file.name}, which is damaged.")
        return [cached for _, cached in read if cached is not None]

    def _path(self, planner: str, request: PlanRequest) -> Path:
        return self.folder / f"{request_hash(planner, request)}.json"


def _read(path: Path) -> CachedAnswer | None:
    """The answer in the file at `path`, None if there is no file or it is damaged."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=CachedAnswer)
    except (FileNotFoundError, *DECODE_ERRORS):
        return None


def request_hash(planner: str, request: PlanRequest) -> str:
    """32 hex digits of the SHA-256 over the planner's id and the complete request."""
    fields = msgspec.to_builtins(request)
    if request.image is None:  # requests of earlier versions keep their hashes
        del fields["image"]
    content = json.dumps([planner, fields], sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()[:32]


class CachingPlanner:
    """Answers from `cache` if it can; otherwise asks the planner that `open_planner` opens, and caches the answer.

    `n_requests` counts the requests that the planner computed; the first of them opens it.
    """

    def __init__(self, id: str, cache: AnswerCache, open_planner: Callable[[], Planner]) -> None:
        """`id` identifies the planner in the cache: its name, and every setting that changes its answers."""
        self.id, self.n_requests = id, 0
        self._cache, self._open = cache, open_planner
        self._planner: Planner | None = None

    @property
    def name(self) -> str:
        """The planner's id."""
        return self.id

    def propose(self, request: PlanRequest) -> Proposal:
        """The cached answer, or a computed one."""
        return self._cache.get(self.id, request) or self.propose_uncached([request])[0]

    def propose_uncached(self, requests: Sequence[PlanRequest]) -> list[Proposal]:
        """Compute the answers to `requests`, in parallel if the planner can, and cache them."""
        self._planner = self._planner or self._open()
        self.n_requests += len(requests)
        proposals = propose_all(self._planner, requests)
        for request, proposal in zip(requests, proposals, strict=True):
            self._cache.put(self.id, request, proposal)
        return proposals

    def is_cached(self, request: PlanRequest) -> bool:
        """Whether the answer is cached."""
        return self._cache.get(self.id, request) is not None

    def close(self) -> None:
        """Close the planner if it is open."""
        if self._planner is not None:
            self._planner.close()
            self._planner = None
