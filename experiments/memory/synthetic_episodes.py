"""Synthetic episodes for experiments on memory: complete records as the runtime would write them, without motion."""

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
"""Start of the synthetic time [s since 1970 UTC]."""
CONFIG = MemoryConfig(limits=(LIMITS,))


def grasp_contract(**params: Any) -> dict[str, Any]:
    """A contract of one grasp with the parameters `params`."""
    context = {"robot": ROBOT, "registry": REGISTRY}
    return {"id": "c-0001", "context": context, "action_sequence": [{"skill": "grasp", "params": params}]}


def synthetic_episode(
    name: str,
    *,
    kind: OutcomeClass = "succeeded",
    Delta: float | None = 0.001,
    instruction: str = "grasp the cube",
    summary: str = "cube: object, neighbour_across low",
    recall: RetrievedContext | None = None,
    plan: dict[str, Any] | None = None,
    proposer: str = "planner",
    second_opinion: OutcomeCheck = "agrees",
) -> Episode:
    """A synthetic episode called `name` with the outcome `kind` and the mean intervention `Delta`."""
    rejected = Rejected(
        stage="envelope", pointer="/action_sequence/0/params/speed", got=1, allowed="0.05..0.4", hint="slower"
    )
    attempt = Attempt(
        Proposal(text="{}", finish_reason="stop", planner=proposer, timings={"total": 0.0}),
        rejected,
        0.0,
    )
    outcome = Outcome(
        kind=kind, reason="" if kind == "succeeded" else f"it {kind}", Delta=None if kind == "rejected" else Delta
    )
    return Episode(
        id=name,
        started="2026-11-21T00:00:00Z",
        instruction=instruction,
        robot=ROBOT,
        registry=REGISTRY,
        seed=0,
        scene=Scene(robot=ROBOT, stamp=0.0, version=1, objects=()),
        summary=summary,
        recall=recall or RetrievedContext(),
        attempts=(attempt,),
        contract=plan or grasp_contract(object="cube", speed=0.1),
        outcome=outcome,
        judgement=None,
        timings={},
        versions={},
        second_opinion=second_opinion,
    )
