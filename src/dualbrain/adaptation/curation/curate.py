"""Curation: from a ledger to a data set D_clean, without near-duplicates, balanced, and split by scene (paper 6.1)."""

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
"""Every sample is stored as a first attempt, even if the contract was the second one of its episode."""


class CurationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of curation.

    `rules` select episodes, `most_repeats` limits the repetitions of a rare sample per epoch, `held_out` is the share
    of held-out scenes, and `salt` determines the split.
    """

    rules: CleanRules = CleanRules()
    most_repeats: int = 4
    held_out: float = 0.2
    salt: str = "dualbrain"

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for a setting that is out of range."""
        if not 1 <= self.most_repeats <= 16:
            raise ConfigurationError("most_repeats", got=self.most_repeats, allowed="1 to 16")
        if not 0.0 <= self.held_out < 1.0:
            raise ConfigurationError("held_out", got=self.held_out, allowed="in [0, 1)")


class CurationResult(msgspec.Struct, frozen=True, kw_only=True):
    """The selected samples, and the ids of excluded memories by reason. `head` was the newest event of the ledger.

    `merged` counts near-duplicates, `memories` all memories that were read. `writers` are the robots of a shared ledger
    whose memories could be selected, sorted; empty: all.
    """

    train: tuple[Sample, ...]
    held_out: tuple[Sample, ...]
    left_out: dict[str, tuple[str, ...]]
    merged: int
    head: Head
    memories: int
    writers: tuple[str, ...] = ()


def curate(
    ledger: LedgerReader,
    registry: SkillRegistry,
    config: CurationConfig,
    *,
    declines: Collection[str] = (),
    site: SkillRegistry | None = None,
) -> CurationResult:
    """The data set of `ledger` for the robot of `registry`; the same ledger and settings give the same data set.

    A declined instruction is no evidence: a planner that declines everything would train itself to do so. Only the
    declines in `declines` (ids of memories) are selected; the caller knows that their instructions are impossible.
    `site` is the narrower vocabulary of a site file: episodes at the site are selected too and written in the robot's
    own vocabulary. Of a shared ledger, only the episodes of the robots in `use_memories_of` are selected, if it names
    any.

    Promise: no scene is on both sides of the split (see `group_scenes`), the present gate accepts every completion
    (`select` states which checks it makes), and every sample names its events. A rollback, a quarantine or a forgotten
    memory changes the result, so curate again before each training run. Raises `ConfigurationError` if no sample is
    left or if `site` is not a narrower vocabulary, `CorruptLedgerError`.
    """
    if site is not None and not is_narrower(site, registry):
        raise ConfigurationError(
            "vocabulary of the site", got=site.hash, allowed=f"one that only narrows {registry.hash}"
        )
    found = list(read_candidates(ledger))
    clean, left_out = select(found, registry, config.rules, declines, site, ledger.usable_writers)
    if not clean:
        problem = f"The ledger has no clean episode: {_describe_exclusions(len(found), left_out)} can be used."
        raise ConfigurationError.stating(problem, fix=_NO_SAMPLES_HINT)
    kept = merge_duplicates(clean)
    representatives = [pair.representative for pair in kept]
    group_of = dict(zip((one.memory.id for one in found), group_scenes(found), strict=True))
    groups, shown = (
        [group_of[one.memory.id] for one in representatives],
        compute_repeats(representatives, registry, config.most_repeats),
    )
    rows = [_build_sample(pair, registry, group, times) for pair, group, times in zip(kept, groups, shown, strict=True)]
    held_out_groups = choose_held_out_groups(groups, config.held_out, config.salt)
    return CurationResult(
        train=tuple(row for row in rows if row.scene not in held_out_groups),
        held_out=tuple(row for row in rows if row.scene in held_out_groups),
        left_out={reason: tuple(names) for reason, names in sorted(left_out.items())},
        merged=len(clean) - len(kept),
        head=ledger.head(),
        memories=len(found),
        writers=tuple(sorted(ledger.usable_writers)),
    )


_NO_SAMPLES_HINT = "Only active successes with little intervention are selected: see `dualbrain memory list`."


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
    """The first 16 hex digits of the SHA-256 of prompt and contract."""
    return hashlib.sha256(msgspec.json.encode([list(prompt), contract])).hexdigest()[:16]


def _event_numbers(one: Candidate, others: Sequence[Candidate]) -> tuple[int, ...]:
    return (one.memory.seq, *(other.memory.seq for other in others))
