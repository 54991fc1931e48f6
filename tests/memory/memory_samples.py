"""Small episodes, limits and memories that the tests of the memory share."""

import sys
from pathlib import Path
from typing import Any

import numpy as np

from dualbrain.contracts.verdict import Rejected
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.embedding.joint_embedding import EmbeddingConfig
from dualbrain.memory.embedding.posture_features import Posture, PostureLimits
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.memory import Memory
from dualbrain.memory.plasticity.hebbian_update import Plasticity
from dualbrain.records import (
    Attempt,
    Episode,
    Judgement,
    Outcome,
    OutcomeCheck,
    OutcomeClass,
    Proposal,
    RetrievedContext,
    Scene,
)

INTERPRETER = (sys.executable, *(("-S",) if sys.flags.no_site else ()))
"""Command that starts a child process with the same packages."""
ARM_LIMITS = PostureLimits("arm", (-3.0, -2.0), (3.0, 2.0), 0.04)
OTHER_LIMITS = PostureLimits("other", (-1.0,), (1.0,), 0.1)
REST_POSTURE = Posture((0.0, 0.5), 0.04)
NOW = 1_800_000_000.0
CONFIG = MemoryConfig(
    limits=(ARM_LIMITS, OTHER_LIMITS), embedding=EmbeddingConfig(features=16), plasticity=Plasticity(kappa=0.0)
)
"""Configuration without a neighbourhood, because most laws are about a single memory."""


def grasp_contract(object_name: str = "red_cube") -> dict[str, Any]:
    return {
        "id": "c-1",
        "context": {"robot": "arm", "registry": "aaaa1111"},
        "action_sequence": [{"skill": "grasp", "params": {"object": object_name, "speed": 0.1}}],
    }


def episode(
    name: str,
    kind: OutcomeClass = "succeeded",
    *,
    Delta: float | None = 0.0,
    instruction: str = "put the red cube in the bowl",
    summary: str = "neighbour_across low",
    recall: RetrievedContext | None = None,
    robot: str = "arm",
    registry: str = "aaaa1111",
    judgement: Judgement | None = None,
    proposed: str = "{}",
    refused: Any = None,
    second_opinion: OutcomeCheck = "agrees",
    plan: dict[str, Any] | None = None,
    proposer: str = "scripted",
) -> Episode:
    verdict = Rejected(
        stage="envelope", pointer="/action_sequence/0/params/speed", got=refused, allowed="0.05..0.4", hint="slower"
    )
    proposal = Proposal(
        text=proposed, finish_reason="stop", planner=proposer, constrained_by="nothing", timings={"total": 0.1}
    )
    return Episode(
        id=name,
        started="2027-01-15T08:00:00Z",
        instruction=instruction,
        robot=robot,
        registry=registry,
        seed=1,
        scene=Scene(robot=robot, stamp=0.0, version=1, objects=()),
        summary=summary,
        recall=recall or RetrievedContext(),
        attempts=(Attempt(proposal, verdict, 1e-4),),
        contract=plan or grasp_contract(),
        outcome=Outcome(
            kind=kind, reason="" if kind == "succeeded" else f"it {kind}", Delta=None if kind == "rejected" else Delta
        ),
        judgement=judgement,
        timings={"plan": 1.0},
        versions={"dualbrain": "0"},
        second_opinion=second_opinion,
    )


def open_ledger(folder: Path, name: str = "ledger.db") -> Ledger:
    return Ledger(folder / name, holder="a test", now=NOW)


def open_memory(ledger: Ledger, config: MemoryConfig = CONFIG) -> Memory:
    return Memory(ledger, HashingEncoder(32), config)


def unit_rows(rng: np.random.Generator, n: int, dim: int) -> np.ndarray:
    rows = rng.standard_normal((n, dim))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
