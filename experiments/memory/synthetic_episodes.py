"""Made-up episodes for proofs about memory itself: everything as the runtime would write it, but nothing has moved."""

from __future__ import annotations

from typing import Any

from dualbrain.contracts.verdict import Rejected
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.posture_features import Posture, PostureLimits
from dualbrain.records import Attempt, Episode, Outcome, OutcomeCheck, OutcomeClass, Proposal, RetrievedContext, Scene

ROBOT, REGISTRY = "arm", "aaaa1111"
LIMITS = PostureLimits(ROBOT, (-3.0, -2.0), (3.0, 2.0), 0.04)
REST_POSTURE = Posture((0.0, 0.5), 0.04)
START_TIME = 1_800_000_000.0
"""When made-up time begins [s, 1970 UTC]."""
CONFIG = MemoryConfig((LIMITS,))


def grasp_contract(**params: Any) -> dict[str, Any]:
    """A contract of one grasp with these parameters."""
    context = {"robot": ROBOT, "registry": REGISTRY}
    return {"id": "c-0001", "context": context, "action_sequence": [{"skill": "grasp", "params": params}]}


def synthetic_episode(
    name: str, *, kind: OutcomeClass = "succeeded", Delta: float | None = 0.001, instruction: str = "grasp the cube",
    summary: str = "cube: object, neighbour_across low", recall: RetrievedContext | None = None,
    plan: dict[str, Any] | None = None, proposer: str = "planner", second_opinion: OutcomeCheck = "agrees",
) -> Episode:  # fmt: skip
    """One episode."""
    refused = Rejected("envelope", "/action_sequence/0/params/speed", 1, "0.05..0.4", "slower")
    attempt = Attempt(Proposal("{}", "stop", proposer, "nobody", {"total": 0.0}), refused, 0.0)
    outcome = Outcome(kind, "" if kind == "succeeded" else f"it {kind}", None if kind == "rejected" else Delta)
    return Episode(
        name, "2026-11-21T00:00:00Z", instruction, ROBOT, REGISTRY, 0, Scene(ROBOT, 0.0, 1, ()), summary,
        recall or RetrievedContext(), (attempt,), plan or grasp_contract(object="cube", speed=0.1), outcome, None, {}, {},
        second_opinion=second_opinion,
    )  # fmt: skip
