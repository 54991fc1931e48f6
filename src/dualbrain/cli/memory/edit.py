"""dualbrain memory, editing commands: audit, quarantine, release, forget, rollback, replay, compact, rebuild."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter

from dualbrain.cli.common.arguments import Seed
from dualbrain.cli.common.console import StderrConsole, print_result, print_table
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
from dualbrain.core.text import count_noun
from dualbrain.errors import ConfigurationError, UnknownNameError

if TYPE_CHECKING:
    from dualbrain.memory.maintenance.audit import SourceReport

Flag = Annotated[bool, Parameter(negative="")]
Note = Annotated[bool, Parameter(negative="--no-note", help="Record the result in the ledger, as an event.")]
COMMAND = "dualbrain memory"


def audit(*, note: Note = False, ledger: Path | None = None, json: Flag = False) -> int:
    """Report label conflicts, near-duplicates, doubtful verdicts, and the influence of each source.

    Memories and weights are not changed. Exit code 1 if there are findings.

    Parameters
    ----------
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.memory.maintenance.audit import audit as examine
    from dualbrain.memory.maintenance.edits import record_audit

    with open_memory(ledger, writing="audit" if note else "") as opened:
        report = examine(opened)
        if note:
            record_audit(opened, report, now=time.time())
    if json:
        print_json(report)
    else:
        for one in report.findings:
            print_result(
                f"{one.kind}: {one.memory}: {one.text}" + (f" ({', '.join(one.others[:6])})" if one.others else "")
            )
        heads = ("source", "memories", "weights changed", "Σ|Δw|", "adapters")
        print_table(heads, map(_source_row, report.sources), wrap_columns=("adapters",))
    StderrConsole().print(
        f"{count_noun(len(report.findings), 'finding')} in {count_noun(report.memories, 'memory', 'memories')}"
    )
    if report.utility.recalled:
        StderrConsole().print(f"retrieval utility: {report.utility}")
    return ExitCode.FAILED_SAFELY if report.findings else ExitCode.SUCCESS


def quarantine(*ids: str, reason: str, source: str = "", ledger: Path | None = None, json: Flag = False) -> int:
    """Exclude memories from retrieval, and undo the effect of their outcomes on weights until they are released.

    Parameters
    ----------
    ids
        Ids of the memories.
    reason
        Reason, recorded in the ledger.
    source
        Also all memories from this source (planner or file).
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.memory.maintenance.edits import quarantine as exclude

    return _apply_change("quarantine", ids, source, reason, ledger, exclude, as_json=json)


def release(*ids: str, reason: str, source: str = "", ledger: Path | None = None, json: Flag = False) -> int:
    """Make quarantined memories and candidates active again; their effect on weights is restored exactly.

    Parameters
    ----------
    ids
        Ids of the memories.
    reason
        Reason, recorded in the ledger.
    source
        Also all memories from this source (planner or file).
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.memory.maintenance.edits import release as restore

    return _apply_change("release", ids, source, reason, ledger, restore, as_json=json)


def forget(*ids: str, reason: str, ledger: Path | None = None, json: Flag = False) -> int:
    """Mark memories as forgotten: never retrieved again, their effect on weights undone; the hash chain stays intact.

    Parameters
    ----------
    ids
        Ids of the memories.
    reason
        Reason, recorded in the ledger.
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.memory.maintenance.edits import forget as mark_forgotten

    return _apply_change("forget", ids, "", reason, ledger, mark_forgotten, as_json=json)


def rollback(event: int, /, *, reason: str, ledger: Path | None = None, json: Flag = False) -> int:
    """Restore the memory as it was at an event. Events are kept: a rollback to a later event undoes this one.

    Parameters
    ----------
    event
        Number of the event, from `dualbrain memory list` or `show`.
    reason
        Reason, recorded in the ledger.
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.memory.maintenance.edits import roll_back

    with open_memory(ledger, writing="rollback") as opened:
        before, head = opened.weights(), opened.ledger.head().seq
        roll_back(opened, event, reason, now=time.time())
        _print_weight_changes("rollback", before, opened.weights(), as_json=json)
    StderrConsole().print(f"To undo: {COMMAND} rollback {head} --reason REASON")
    return ExitCode.SUCCESS


def replay(
    name: str, /, *, tries: int = 5, seed: Seed = 0, note: Note = True, ledger: Path | None = None, json: Flag = False
) -> int:
    """Run a remembered contract again in simulation, through gate and filter, and compare outcome and Δ.

    Exit code 0 if the memory is confirmed, 1 if it is contradicted. A contradicted memory is not quarantined
    automatically; see `quarantine`.

    Parameters
    ----------
    name
        Id of the memory.
    tries
        Number of simulations, each with a slightly different scene.
    seed
        Seed of the scene variations and of perception.
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.memory.maintenance.edits import record_replay
    from dualbrain.memory.state.derivation import derive_state
    from dualbrain.runtime.inspection.memory_replay import replay_memory

    if tries < 1:
        raise ConfigurationError("tries", got=tries, allowed="at least 1")
    with open_reader(ledger) as opened:
        state = derive_state(opened)
        if name not in state:
            raise UnknownNameError("memory", name, tuple(state.rows), owner="this ledger")
        finding = replay_memory(opened, state[name], tries=tries, seed=seed, actor=f"{COMMAND} replay")
    if note:
        with open_memory(ledger, writing="replay") as opened:
            record_replay(opened, finding, now=time.time())
    if json:
        print_json(finding)
    for kind, size in zip(finding.outcomes, finding.Deltas, strict=True):
        StderrConsole().print(f"  {kind}, Δ {'-' if size is None else f'{size:.4f}'}", markup=False)
    StderrConsole().print(
        f"{name} ({finding.remembered}): {'confirmed' if finding.agrees else 'contradicted'}; {finding.reason}",
        markup=False,
    )
    return ExitCode.SUCCESS if finding.agrees else ExitCode.FAILED_SAFELY


def compact(*, ledger: Path | None = None, json: Flag = False) -> int:
    """Write a shorter ledger with bit-identical memories, weights and statuses; the original is kept as an archive.

    Parameters
    ----------
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.memory.ledger.ledger import LedgerReader
    from dualbrain.memory.maintenance.compaction import compact_in_place

    path = ledger_path(ledger)
    LedgerReader(path).close()  # a command never creates a ledger
    before = path.stat().st_size
    archive = compact_in_place(path, holder=f"{COMMAND} compact", now=time.time(), timeout_s=LOCK_TIMEOUT_S)
    sizes = {"before": before, "after": path.stat().st_size, "archive": str(archive)}
    if json:
        print_json(sizes)
    StderrConsole().print(f"{before / 1e6:.1f} MB -> {sizes['after'] / 1e6:.1f} MB; archive: {archive}", markup=False)
    return ExitCode.SUCCESS


def rebuild(*, ledger: Path | None = None, json: Flag = False) -> int:
    """Recompute all vectors from the episodes and write a snapshot, after a change of the encoder or a fault.

    Parameters
    ----------
    ledger
        Memory ledger. Default: ledger.sqlite in the data folder of dualbrain.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.memory.embedding.joint_embedding import JointEmbedding
    from dualbrain.memory.index.index import rebuild_vectors
    from dualbrain.memory.ledger.ledger import Ledger, LedgerReader
    from dualbrain.memory.memory import Memory

    path = ledger_path(ledger)
    LedgerReader(path).close()
    with Ledger(
        path, holder=f"{COMMAND} rebuild", now=time.time(), timeout_s=LOCK_TIMEOUT_S, run_folders=RUN_FOLDERS
    ) as opened:
        config, encoder = memory_config(opened), load_encoder()
        count = rebuild_vectors(opened, JointEmbedding(encoder, config.limits, config.embedding))
        Memory(opened, encoder, config).write_snapshot(opened, now=time.time())
    if json:
        print_json({"vectors": count})
    StderrConsole().print(f"{count} vectors recomputed")
    return ExitCode.SUCCESS


def _source_row(one: SourceReport) -> tuple[str, ...]:
    return (one.source, str(len(one.memories)), str(one.touched), f"{one.moved:.2f}", ", ".join(one.adapters) or "-")


def _apply_change(
    what: str,
    ids: tuple[str, ...],
    source: str,
    reason: str,
    ledger: Path | None,
    apply: Callable[..., None],
    *,
    as_json: bool,
) -> int:
    with open_memory(ledger, writing=what) as opened:
        more = [memo.id for memo in opened.state.memories if source and memo.provenance.source == source]
        if source and not more:
            raise ConfigurationError.stating(
                f"No memory has the source {source!r}.", fix="`dualbrain memory show ID` prints the source of a memory."
            )
        names = tuple(dict.fromkeys((*ids, *more)))
        before = opened.weights()
        apply(opened, names, reason, now=time.time(), actor=COMMAND)
        _print_weight_changes(what, before, opened.weights(), as_json=as_json, names=names)
    return ExitCode.SUCCESS


def _print_weight_changes(
    what: str, before: dict[str, float], after: dict[str, float], *, as_json: bool, names: tuple[str, ...] = ()
) -> None:
    changed: dict[str, Any] = {
        name: [before.get(name), after.get(name)] for name in {**before, **after} if before.get(name) != after.get(name)
    }
    if as_json:
        print_json({"command": what, "memories": names, "weights": msgspec.to_builtins(changed)})
    for name, (old, new) in list(changed.items())[:20]:
        StderrConsole().print(
            f"  {name}: {'-' if old is None else f'{old:.3f}'} -> {'-' if new is None else f'{new:.3f}'}", markup=False
        )
    StderrConsole().print(
        f"{what}: {len(names) or 'no'} memories selected, {len(changed)} weights changed", markup=False
    )
