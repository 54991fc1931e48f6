"""From a ledger to a data set: D_clean, near-duplicates merged, balanced, split by scene (paper 6.1)."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence

import msgspec

from dualbrain.adaptation.curation.balancing import compute_repeats
from dualbrain.adaptation.curation.candidate import Candidate, read_candidates
from dualbrain.adaptation.curation.deduplication import DuplicateGroup, merge_duplicates
from dualbrain.adaptation.curation.sample import DuplicateSource, Sample, assistant_turn
from dualbrain.adaptation.curation.scene_split import choose_held_out_groups, group_scenes
from dualbrain.adaptation.curation.selection import CleanRules, select, with_registry
from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.registry import SkillRegistry, is_narrower
from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.hash_chain import Head
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.planner.prompt.short_prompt import render_short

CONTRACT_ID = "c-0001"
"""Every sample is asked and answered as a first shot, also where the contract came at the second."""


class CurationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The dials: who is let in, the most repeats of a rare sample, the share of held-out scenes, the draw's salt."""

    rules: CleanRules = CleanRules()
    most_repeats: int = 4
    held_out: float = 0.2
    salt: str = "dualbrain"

    def __post_init__(self) -> None:
        """Raise `InvalidSetup` for dials out of range."""
        if not 1 <= self.most_repeats <= 16:
            raise ConfigurationError("most_repeats", got=self.most_repeats, allowed="1 to 16")
        if not 0.0 <= self.held_out < 1.0:
            raise ConfigurationError("held_out", got=self.held_out, allowed="in [0, 1)")


class CurationResult(msgspec.Struct, frozen=True, kw_only=True):
    """What would be taught and tested, and what was left out: ids by reason. `head` was the ledger's newest event."""

    train: tuple[Sample, ...]
    held_out: tuple[Sample, ...]
    left_out: dict[str, tuple[str, ...]]
    merged: int
    head: Head
    memories: int


def curate(
    ledger: LedgerReader,
    registry: SkillRegistry,
    config: CurationConfig,
    *,
    declines: Collection[str] = (),
    site: SkillRegistry | None = None,
) -> CurationResult:
    """The data set of `ledger` for the robot of `registry`; the same ledger and dials give the same set.

    A decline proves nothing: a planner that declines everything would teach itself to. So none is let in but those that
    are named in `declines` (ids of memories), by whoever asked for what cannot be done and knew it. `site` is the
    vocabulary where a site file narrows that of the robot: what was done there teaches too, in the robot's own words.

    Promise: no scene is on both sides (see `scene_groups`), every completion is accepted by today's gate (`select` says
    what of it), every sample leads back to its events. A rollback, a quarantine or a forgotten memory changes what it
    finds: always curate anew. Raises `InvalidSetup` if nothing is left or `site` is another vocabulary,
    `DamagedLedger`.
    """
    if site is not None and not is_narrower(site, registry):
        raise ConfigurationError(
            "vocabulary of the site", got=site.hash, allowed=f"one that only narrows {registry.hash}"
        )
    found = list(read_candidates(ledger))
    clean, left_out = select(found, registry, config.rules, declines, site)
    if not clean:
        raise ConfigurationError(
            "clean episodes",
            got=_describe_exclusions(len(found), left_out),
            allowed="at least one",
            fix=_NO_SAMPLES_HINT,
        )
    kept = merge_duplicates(clean)
    ones = [pair.representative for pair in kept]
    named = dict(zip((one.memory.id for one in found), group_scenes(found), strict=True))
    groups, shown = [named[one.memory.id] for one in ones], compute_repeats(ones, registry, config.most_repeats)
    rows = [_build_sample(pair, registry, group, times) for pair, group, times in zip(kept, groups, shown, strict=True)]
    apart = choose_held_out_groups(groups, config.held_out, config.salt)
    return CurationResult(
        train=tuple(row for row in rows if row.scene not in apart),
        held_out=tuple(row for row in rows if row.scene in apart),
        left_out={reason: tuple(names) for reason, names in sorted(left_out.items())},
        merged=len(clean) - len(kept),
        head=ledger.head(),
        memories=len(found),
    )


_NO_SAMPLES_HINT = "See `dualbrain memory list`: only successes that are believed, with little intervention, can teach."


def _describe_exclusions(found: int, left_out: dict[str, list[str]]) -> str:
    reasons = ", ".join(f"{len(names)} {reason}" for reason, names in sorted(left_out.items()))
    return f"none of {found} memories" + (f" ({reasons})" if reasons else "")


def _build_sample(kept: DuplicateGroup, registry: SkillRegistry, scene: str, shown: int) -> Sample:
    one = kept.representative
    assert one.contract is not None
    prompt = render_short(
        one.summary, one.instruction, robot=registry.robot, registry=registry.hash, contract_id=CONTRACT_ID
    )
    text = canonical_contract(msgspec.structs.replace(with_registry(one.contract, registry), id=CONTRACT_ID), registry)
    messages = [{"role": turn["role"], "content": turn["content"]} for turn in prompt]
    return Sample(
        id=content_id(messages, text),
        prompt=messages,
        completion=assistant_turn(text),
        weight=one.memory.weight,
        Delta=one.memory.Delta or 0.0,
        duration=one.duration,
        repeats=shown,
        scene=scene,
        memory=one.memory.id,
        events=_event_numbers(one, kept.duplicates),
        source=one.memory.provenance.source,
        graspable=one.scene.graspable,
        receptive=one.scene.receptive,
        others=tuple(DuplicateSource(same.memory.id, same.memory.provenance.source) for same in kept.duplicates),
    )


def content_id(prompt: Sequence[dict[str, str]], contract: str) -> str:
    """First 16 hex digits of the SHA-256 of prompt and contract."""
    return hashlib.sha256(msgspec.json.encode([list(prompt), contract])).hexdigest()[:16]


def _event_numbers(one: Candidate, others: Sequence[Candidate]) -> tuple[int, ...]:
    return (one.memory.seq, *(other.memory.seq for other in others))
