"""dualbrain memory, read-only commands: list, show, search, export, verify."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
from cyclopts import Parameter
from rich.markup import escape

from dualbrain.cli.common.console import StderrConsole, print_result, print_table, sanitize_line
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.memory.open_memory import (
    LOCK_TIMEOUT_S,
    RUN_FOLDERS,
    ledger_path,
    load_encoder,
    memory_config,
    open_memory,
    open_reader,
    print_json,
)
from dualbrain.core.storage.private_files import open_private
from dualbrain.core.text import count_noun
from dualbrain.errors import ConfigurationError, UnknownNameError, UsageError
from dualbrain.memory.ledger.events import Status
from dualbrain.records import OutcomeClass

if TYPE_CHECKING:
    from dualbrain.memory.ledger.ledger import LedgerReader
    from dualbrain.memory.maintenance.verification import Verification
    from dualbrain.memory.state.state import LedgerState, MemoryState
    from dualbrain.records import Exemplar

Flag = Annotated[bool, Parameter(negative="")]
HASH_CHARACTERS = 8
MAX_DIGITS = 18
"""Digits of the largest number of an event."""
"""Number of characters of the hash of a source in a list."""
MAX_LISTED_FAULTS = 20
"""Number of wrong vectors that `verify` lists."""


def list_memories(
    *,
    status: Status | None = None,
    outcome: OutcomeClass | None = None,
    source: str = "",
    at: str = "",
    limit: int = 50,
    ledger: Path | None = None,
    json: Flag = False,
) -> int:
    """List memories, newest first: id, instruction, age, outcome, Δ, weight w, status, source.

    Parameters
    ----------
    status
        Only memories with this status.
    outcome
        Only memories with this outcome.
    source
        Only memories from this planner or file.
    at
        State of the memory at an event number, or at a time such as 2026-11-21T14:00 (UTC).
    limit
        Maximum number of rows; 0 for all.
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    json
        Print one JSON object on stdout.
    """
    if limit < 0:
        raise UsageError("--limit", got=limit, allowed="0 (all memories) or more")
    with open_reader(ledger) as opened:
        state = _state_at(opened, at)
        wanted = [
            memo
            for memo in reversed(state.memories)
            if status in (None, memo.status) and outcome in (None, memo.kind) and source in ("", memo.provenance.source)
        ]
        shown = wanted[:limit] if limit else wanted
        instructions = [_instruction(opened, memo) for memo in shown]
    if json:
        print_json({"memories": shown, "total": len(wanted), "event": state.seq})
        return ExitCode.SUCCESS
    now = time.time()
    heads = ("id", "instruction", "age", "outcome", "Δ", "w", "status", "source")
    rows = (_memory_row(memo, words, now) for memo, words in zip(shown, instructions, strict=True))
    print_table(heads, rows, wrap_columns=("instruction",))
    StderrConsole().print(f"{len(shown)} of {count_noun(len(wanted), 'memory', 'memories')}, at event {state.seq}")
    return ExitCode.SUCCESS


def show(name: str, /, *, ledger: Path | None = None, json: Flag = False) -> int:
    """Show one memory: instruction, contract, outcome, provenance, and every change of its weight.

    Parameters
    ----------
    name
        Id of the memory, from `dualbrain memory list`.
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.memory.ledger.events import FOLDED, REPLAYED, WEIGHT
    from dualbrain.memory.state.derivation import derive_state

    with open_reader(ledger) as opened:
        state = derive_state(opened)
        if name not in state:
            raise UnknownNameError("memory", name, tuple(state.rows), owner="this ledger")
        memo = state[name]
        stored = msgspec.json.decode(opened.event(memo.seq).payload)
        history = [
            {"event": event.seq, "kind": event.kind, "time": event.time, **msgspec.json.decode(event.payload)}
            for event in opened.events(WEIGHT, FOLDED, REPLAYED, subject=name)
        ]
    if json:
        print_json({"memo": memo, "stored": stored, "history": history})
        return ExitCode.SUCCESS
    episode = stored["episode"]
    print_result(f"{name}: {sanitize_line(episode['instruction'])}")
    for line in episode["summary"].splitlines():
        print_result(sanitize_line(line))
    print_result(f"contract: {msgspec.json.encode(episode['contract']).decode()}")
    ending = f"{memo.kind} {sanitize_line(episode['outcome']['reason'])}".rstrip()
    print_result(f"outcome: {ending}; Δ {memo.Delta}; w {memo.weight:.3f}; {memo.status}")
    print_result(f"provenance: {msgspec.json.encode(memo.provenance).decode()}")
    for one in history:
        moved = (
            f"{one['rule']} by {one['cause']}: {one['before']:.3f} -> {one['after']:.3f}"
            if "rule" in one
            else one["kind"]
        )
        print_result(f"  event {one['event']}, {_format_time(one['time'])}: {moved}")
    return ExitCode.SUCCESS


def search(
    instruction: str,
    /,
    *,
    scene: str = "0",
    robot: str = "panda",
    k: int = 5,
    lambda_s: float | None = None,
    diversity: float | None = None,
    skills: tuple[str, ...] = (),
    outcome: tuple[OutcomeClass, ...] = (),
    after: str = "",
    before: str = "",
    status: tuple[Status, ...] = ("active",),
    ledger: Path | None = None,
    json: Flag = False,
) -> int:
    """Search memory as a run would: the best exemplars and warnings for an instruction and a scene, with score parts.

    Parameters
    ----------
    instruction
        The instruction, in words.
    scene
        The scene: a number, FAMILY:SEED or a scene file.
    robot
        The robot.
    k
        Number of exemplars.
    lambda_s
        Weight of the similarity s against the learned weight w: R = lambda_s s + (1 - lambda_s) w.
    diversity
        0 selects by score alone; towards 1, dissimilar memories among the best are preferred.
    skills
        Only contracts with these skills.
    outcome
        Only memories with these outcomes.
    after
        Only memories stored after this time (UTC).
    before
        Only memories stored before this time (UTC).
    status
        Statuses that are searched; candidates and quarantined memories only on request.
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.grounding.offline_gate import scene_from_spec
    from dualbrain.grounding.scene_summary import summarise_scene
    from dualbrain.grounding.vocabulary import load_skill_registry
    from dualbrain.memory.embedding.posture_features import Posture
    from dualbrain.memory.index.filters import Filter
    from dualbrain.robots.interface import home_state
    from dualbrain.robots.loader import load_robot
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    if k < 1:
        raise UsageError("--k", got=k, allowed="at least 1")
    perceived = scene_from_spec(open_scene(scene, robot))
    state = home_state(load_robot(robot))
    posture = Posture(tuple(state.q.tolist()), state.opening)
    where = Filter(
        skills=skills,
        outcomes=outcome,
        statuses=status,
        after=_parse_time(after),
        before=_parse_time(before),
    )
    with open_memory(ledger) as opened:
        recall = opened.retrieve(
            instruction,
            summarise_scene(perceived),
            posture,
            robot,
            load_skill_registry(robot).hash,
            k=k,
            lambda_s=lambda_s,
            diversity=diversity,
            where=where,
        )
    if json:
        print_json(recall)
        return ExitCode.SUCCESS
    rows = [_hit_row("follow", hit) for hit in recall.exemplars] + [_hit_row("avoid", hit) for hit in recall.warnings]
    print_table(
        ("use", "rank", "R", "s", "w", "id", "instruction", "parts"), rows, wrap_columns=("instruction", "parts")
    )
    return ExitCode.SUCCESS


def export(out: Path | None = None, /, *, ledger: Path | None = None) -> int:
    """Write all memories as JSON lines, with weights, statuses and provenance, to a file or to stdout.

    Parameters
    ----------
    out
        Output file, which must not exist. Default: stdout.
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    """
    from dualbrain.memory.maintenance.export import export_rows
    from dualbrain.memory.state.derivation import derive_state

    with open_reader(ledger) as opened:
        lines = (msgspec.json.encode(row) + b"\n" for row in export_rows(opened, derive_state(opened)))
        if out is None:
            for line in lines:
                print_result(line.decode().rstrip("\n"))
        else:
            with open_private(out, "xb") as file:
                file.writelines(lines)
    return ExitCode.SUCCESS


def verify(*, vectors: Flag = False, accept: str = "", ledger: Path | None = None, json: Flag = False) -> int:
    """Verify hash chain, anchors, weights, snapshot and digests of vectors. Exit code 1 if any of them is wrong.

    Parameters
    ----------
    vectors
        Also recompute every vector and compare it bit for bit.
    accept
        Reason for which a ledger that lacks events of its anchors, or its triggers, is accepted as it is; recorded in
        the ledger. A broken chain cannot be accepted.
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.memory.embedding.joint_embedding import JointEmbedding
    from dualbrain.memory.maintenance.verification import verify as examine

    if accept:
        _accept(ledger_path(ledger), accept)
    with open_reader(ledger, warn=False) as opened:
        embedding = JointEmbedding(load_encoder(), memory_config(opened).limits) if vectors else None
        found = examine(opened, embedding=embedding, run_folders=RUN_FOLDERS)
    if json:
        print_json({"whole": found.is_intact, **msgspec.to_builtins(found)})
    chain = found.chain
    words = f"{chain.events} events, " + (
        "chain intact" if chain.is_intact else f"chain broken at {chain.broken_at}: {chain.fault}"
    )
    checked = "" if found.vectors_wrong is None else f", {found.vectors_wrong} vectors differ"
    StderrConsole().print(
        f"{words}; {count_noun(found.memories, 'memory', 'memories')}; snapshot {found.snapshot}{checked}; "
        f"head {chain.head.hash[:16]}"
    )
    for line in _verification_details(found):
        StderrConsole().print(escape(line))
    return ExitCode.SUCCESS if found.is_intact else ExitCode.FAILED_SAFELY


def _accept(path: Path, reason: str) -> None:
    from dualbrain.memory.maintenance.acceptance import accept_ledger

    report = accept_ledger(
        path,
        reason,
        holder="dualbrain memory verify",
        now=time.time(),
        timeout_s=LOCK_TIMEOUT_S,
        run_folders=RUN_FOLDERS,
        actor="dualbrain memory verify",
    )
    for fault in report.faults:
        StderrConsole().print(escape(f"accepted: {fault.sentence}"))


def _verification_details(found: Verification) -> Iterator[str]:
    """Sentences about faults of vectors, anchors and the file, and about everything that was not compared."""
    faults = found.vectors.faults
    for seq, fault in list(faults.items())[:MAX_LISTED_FAULTS]:
        yield f"event {seq}: {fault}"
    if faults:
        total = count_noun(len(faults), "vector")
        yield f"{total} differ from the digests in their events. Recompute them with `dualbrain memory rebuild`."
    if found.vectors.without_digest:
        total = count_noun(found.vectors.without_digest, "vector")
        yield (
            f"{total} of a ledger of an earlier version have no digest in the chain and were not compared: "
            "`dualbrain memory rebuild` records them."
        )
    yield from found.anchor_faults
    if found.anchor_faults:
        yield "Restore the newest copy of the ledger. If the loss is intended, accept it with --accept REASON."
    yield from (f"file: {fault}" for fault in found.file_faults)
    yield from found.notices


def _instruction(opened: LedgerReader, memo: MemoryState) -> str:
    """The instruction of a memory, from its event in the ledger."""
    return str(msgspec.json.decode(opened.event(memo.seq).payload)["episode"]["instruction"])


def _memory_row(memo: MemoryState, instruction: str, now: float) -> tuple[str, ...]:
    numbers = ("-" if memo.Delta is None else f"{memo.Delta:.4f}", f"{memo.weight:.2f}")
    age, source = format_age(now - memo.time), _shorten_hash(memo.provenance.source)
    return (memo.id, instruction or "(a given contract)", age, memo.kind, *numbers, memo.status, source)


def format_age(seconds: float) -> str:
    """An age [s] in its largest whole unit, such as "3 h"."""
    for unit, length in (("d", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"


def _shorten_hash(source: str) -> str:
    """A source whose hash has its first characters only; `show` prints it whole."""
    name, plus, digest = source.partition("+")
    return f"{name}{plus}{digest[:HASH_CHARACTERS]}{'…' if len(digest) > HASH_CHARACTERS else ''}"


def _hit_row(use: str, hit: Exemplar) -> tuple[str, ...]:
    parts = " ".join(f"{name} {value:.2f}" for name, value in hit.parts.items())
    numbers = (f"{value:.3f}" for value in (hit.score, hit.similarity, hit.weight))
    return (use, str(hit.rank), *numbers, hit.episode_id, hit.instruction, parts)


def _state_at(opened: LedgerReader, at: str) -> LedgerState:
    from dualbrain.memory.state.derivation import derive_state, derive_state_at

    if at.isdecimal() and len(at) < MAX_DIGITS:
        return derive_state(opened, head=min(int(at), opened.head().seq))
    return derive_state(opened) if not at else derive_state_at(opened, _parse_time(at) or 0.0)


def _parse_time(text: str) -> float | None:
    """Seconds since 1970 of an ISO 8601 time, UTC if it names no zone; None for ""."""
    if not text:
        return None
    try:
        time = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigurationError("time", got=text, allowed="ISO 8601, such as 2026-11-21T14:00") from error
    return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()


def _format_time(time: float) -> str:
    return datetime.fromtimestamp(time, UTC).strftime("%Y-%m-%d %H:%M")
