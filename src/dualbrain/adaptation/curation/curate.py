"""From a ledger to a data set: D_clean, near-duplicates merged, balanced, split by scene (paper 6.1)."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Sequence

import msgspec

from dualbrain.adaptation.curation.balancing import repeats
from dualbrain.adaptation.curation.candidate import Candidate, candidates
from dualbrain.adaptation.curation.deduplication import Kept, merge
from dualbrain.adaptation.curation.sample import Other, Sample, answer
from dualbrain.adaptation.curation.scene_split import held_out, scene_groups
from dualbrain.adaptation.curation.selection import CleanRules, as_of, select
from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.registry import Registry, narrows
from dualbrain.errors import InvalidSetup
from dualbrain.memory.ledger.hash_chain import Head
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.planner.prompt.short_prompt import render_short

CONTRACT_ID = "c-0001"
"""Every sample is asked and answered as a first shot, also where the contract came at the second."""


class Curation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The dials: who is let in, the most repeats of a rare sample, the share of held-out scenes, the draw's salt."""

    rules: CleanRules = CleanRules()
    most_repeats: int = 4
    held_out: float = 0.2
    salt: str = "dualbrain"

    def __post_init__(self) -> None:
        """Raise `InvalidSetup` for dials out of range."""
        if not 1 <= self.most_repeats <= 16:
            raise InvalidSetup("most_repeats", got=self.most_repeats, allowed="1 to 16")
        if not 0.0 <= self.held_out < 1.0:
            raise InvalidSetup("held_out", got=self.held_out, allowed="in [0, 1)")


class Curated(msgspec.Struct, frozen=True):
    """What would be taught and tested, and what was left out: ids by reason. `head` was the ledger's newest event."""

    train: tuple[Sample, ...]
    held_out: tuple[Sample, ...]
    left_out: dict[str, tuple[str, ...]]
    merged: int
    head: Head
    memories: int


def curate(
    ledger: LedgerReader, registry: Registry, dials: Curation, *, declines: Collection[str] = (),
    site: Registry | None = None,
) -> Curated:  # fmt: skip
    """The data set of `ledger` for the robot of `registry`; the same ledger and dials give the same set.

    A decline proves nothing: a planner that declines everything would teach itself to. So none is let in but those that
    are named in `declines` (ids of memories), by whoever asked for what cannot be done and knew it. `site` is the
    vocabulary where a site file narrows that of the robot: what was done there teaches too, in the robot's own words.

    Promise: no scene is on both sides (see `scene_groups`), every completion is accepted by today's gate (`select` says
    what of it), every sample leads back to its events. A rollback, a quarantine or a forgotten memory changes what it
    finds: always curate anew. Raises `InvalidSetup` if nothing is left or `site` is another vocabulary,
    `DamagedLedger`.
    """
    if site is not None and not narrows(site, registry):
        raise InvalidSetup("vocabulary of the site", got=site.hash, allowed=f"one that only narrows {registry.hash}")
    found = list(candidates(ledger))
    clean, left_out = select(found, registry, dials.rules, declines, site)
    if not clean:
        raise InvalidSetup("clean episodes", got=_told(len(found), left_out), allowed="at least one", fix=_FIX)
    kept = merge(clean)
    ones = [pair.one for pair in kept]
    named = dict(zip((one.memo.id for one in found), scene_groups(found), strict=True))
    groups, shown = [named[one.memo.id] for one in ones], repeats(ones, registry, dials.most_repeats)
    rows = [_sample(pair, registry, group, times) for pair, group, times in zip(kept, groups, shown, strict=True)]
    apart = held_out(groups, dials.held_out, dials.salt)
    return Curated(
        tuple(row for row in rows if row.scene not in apart), tuple(row for row in rows if row.scene in apart),
        {reason: tuple(names) for reason, names in sorted(left_out.items())}, len(clean) - len(kept), ledger.head(),
        len(found),
    )  # fmt: skip


_FIX = "See `dualbrain memory list`: only successes that are believed, with little intervention, can teach."


def _told(found: int, left_out: dict[str, list[str]]) -> str:
    reasons = ", ".join(f"{len(names)} {reason}" for reason, names in sorted(left_out.items()))
    return f"none of {found} memories" + (f" ({reasons})" if reasons else "")


def _sample(kept: Kept, registry: Registry, scene: str, shown: int) -> Sample:
    one = kept.one
    assert one.contract is not None
    prompt = render_short(
        one.summary, one.instruction, robot=registry.robot, registry=registry.hash, contract_id=CONTRACT_ID
    )
    text = canonical_contract(msgspec.structs.replace(as_of(one.contract, registry), id=CONTRACT_ID), registry)
    messages = [{"role": turn["role"], "content": turn["content"]} for turn in prompt]
    return Sample(
        content_id(messages, text), messages, answer(text), one.memo.weight, one.memo.Delta or 0.0, one.duration,
        shown, scene, one.memo.id, _events(one, kept.repeats), one.memo.provenance.source, one.scene.graspable,
        one.scene.receptive, tuple(Other(same.memo.id, same.memo.provenance.source) for same in kept.repeats),
    )  # fmt: skip


def content_id(prompt: Sequence[dict[str, str]], contract: str) -> str:
    """First 16 hex digits of the SHA-256 of prompt and contract."""
    return hashlib.sha256(msgspec.json.encode([list(prompt), contract])).hexdigest()[:16]


def _events(one: Candidate, others: Sequence[Candidate]) -> tuple[int, ...]:
    return (one.memo.seq, *(other.memo.seq for other in others))
