"""Provenance of a memory. The runtime writes it, and no text of a model can change it."""

from __future__ import annotations

import hashlib
from typing import Any

import msgspec

from dualbrain.core.text import make_json_safe
from dualbrain.memory.plasticity.plan_similarity import contract_actions
from dualbrain.records import REUSED_CONTRACT, Episode

PERSON_SOURCE = "person"


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """The origin of one memory.

    `source` is the proposer of the contract (a planner with its adapter, or a file); influence is bounded per source.
    `scene` and `contract` are digests of the perceived scene and of the actions, `skills` the skill names in order.
    Robot, registry hash and program versions are stored in the episode itself.
    """

    source: str = "unknown"
    adapter: str = ""
    scene: str = ""
    contract: str = ""
    skills: tuple[str, ...] = ()
    seed: int = 0


def episode_provenance(episode: Episode) -> Provenance:
    """The provenance of `episode`, from the fields that the runtime wrote."""
    planner = episode.attempts[-1].proposal.planner if episode.attempts else PERSON_SOURCE
    adapter = "" if planner == REUSED_CONTRACT else episode.versions.get("adapter", "")
    plan = contract_actions(episode.contract)
    return Provenance(
        source=f"{planner}+{adapter}" if adapter else planner,
        adapter=adapter,
        scene=content_digest(msgspec.to_builtins(episode.scene)),
        contract=content_digest(plan),
        skills=tuple(str(action.get("skill", "")) for action in plan),
        seed=episode.seed,
    )


def content_digest(value: Any) -> str:
    """First 16 hex digits of the SHA-256 of the canonical JSON of `value`."""
    return hashlib.sha256(msgspec.json.encode(make_json_safe(value), order="deterministic")).hexdigest()[:16]
