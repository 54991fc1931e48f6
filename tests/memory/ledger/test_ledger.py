"""The ledger: chain, tampering, crashes, one writer, interrupted runs, hostile text."""

import os
import signal
import sqlite3
import subprocess
import time
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.memory.ledger.hash_chain import GENESIS, CorruptLedgerError, Head, event_digest
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, PendingEvent, StoredVector
from dualbrain.memory.ledger.store import HeadMovedError
from dualbrain.memory.ledger.writer_lock import LedgerInUseError
from tests.memory.ledger import crash_writer
from tests.memory.memory_samples import INTERPRETER, NOW, open_ledger


def _filled(folder: Path, events: int = 6) -> Path:
    with open_ledger(folder) as ledger:
        for i in range(events):
            ledger.append(
                [
                    PendingEvent(
                        kind="note", subject=f"s{i}", payload={"text": f"number {i}"}, vector=StoredVector("v", b"\0\0")
                    )
                ],
                now=NOW + i,
            )
    return folder / "ledger.db"


def _tamper(path: Path, *statements: str) -> None:
    """Change the file as an attacker with access could: drop the triggers, then write."""
    database = sqlite3.connect(path)
    for statement in ("DROP TRIGGER event_is_never_changed", "DROP TRIGGER event_is_never_removed", *statements):
        database.execute(statement)
    database.commit()
    database.close()


def test_an_empty_ledger_is_intact(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        report = ledger.verify()
    assert (report.is_intact, report.events, report.head) == (True, 0, Head(0, GENESIS))


def test_events_are_read_as_they_were_written(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        written = ledger.append(
            [
                PendingEvent(kind="note", subject="a", payload={"x": 1.5}),
                PendingEvent(kind="note", subject="b", payload=[1, 2]),
            ],
            now=NOW,
        )
        assert tuple(ledger.events()) == written
        assert ledger.head() == Head(2, written[1].hash)
        assert written[1].previous == written[0].hash
    with LedgerReader(tmp_path / "ledger.db") as reader:
        assert tuple(reader.events()) == written


@pytest.mark.parametrize(
    "change",
    [
        "kind = 'nots'",
        "run = 'other'",
        "subject = 's9'",
        "time = time + 1e-6",
        "payload = CAST(replace(CAST(payload AS TEXT), 'number', 'numbes') AS BLOB)",
        "payload = CAST(payload AS TEXT) || ' '",
        "previous = replace(previous, substr(previous, 1, 1), 'x')",
        "hash = replace(hash, substr(hash, 9, 1), 'x')",
        "subject = CAST(x'ff41' AS TEXT)",
        "time = 'noon'",
    ],
)
@pytest.mark.parametrize("seq", [1, 4, 6])
def test_a_changed_event_is_found_and_named(tmp_path: Path, change: str, seq: int) -> None:
    path = _filled(tmp_path)
    _tamper(path, f"UPDATE event SET {change} WHERE seq = {seq}")
    with LedgerReader(path) as reader:
        report = reader.verify()
    assert (report.is_intact, report.broken_at, report.events) == (False, seq, seq - 1)


@pytest.mark.parametrize(
    ("statement", "broken_at"),
    [
        ("DELETE FROM event WHERE seq = 3", 3),
        ("UPDATE event SET seq = seq + 10 WHERE seq = 6", 6),
        ("UPDATE event SET payload = (SELECT payload FROM event WHERE seq = 2) WHERE seq = 5", 5),
    ],
)
def test_a_removed_or_moved_event_is_found(tmp_path: Path, statement: str, broken_at: int) -> None:
    path = _filled(tmp_path)
    _tamper(path, statement)
    with LedgerReader(path) as reader:
        assert reader.verify().broken_at == broken_at


def test_a_removed_event_is_reported_as_missing(tmp_path: Path) -> None:
    path = _filled(tmp_path)
    _tamper(path, "DELETE FROM event WHERE seq = 3")
    with LedgerReader(path) as reader:
        assert reader.verify().fault == "event 3 is missing; the next event in the file is 4"


def test_a_changed_event_with_a_new_hash_is_found_at_the_next_event(tmp_path: Path) -> None:
    path = _filled(tmp_path)
    with LedgerReader(path) as reader:
        forged = replace(list(reader.events())[2], payload=b"{}")
    _tamper(path, f"UPDATE event SET payload = CAST('{{}}' AS BLOB), hash = '{event_digest(forged)}' WHERE seq = 3")
    with LedgerReader(path) as reader:
        report = reader.verify()
    assert (report.broken_at, report.fault) == (4, "it does not name the previous event as its predecessor")


def test_a_shortened_ledger_is_found_by_an_anchor(tmp_path: Path) -> None:
    path = _filled(tmp_path)
    with LedgerReader(path) as reader:
        anchor = reader.head()
    _tamper(path, "DELETE FROM event WHERE seq > 4")
    with LedgerReader(path) as reader:
        assert reader.verify().is_intact
        report = reader.verify(anchor)
    assert report.broken_at == 5
    assert "ends at event 4" in report.fault


def test_a_rewritten_chain_is_found_by_an_anchor(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    with LedgerReader(_filled(tmp_path / "a")) as reader:
        anchor = reader.head()
    with open_ledger(tmp_path / "b") as forged:
        for i in range(8):
            forged.append([PendingEvent(kind="note", subject="s", payload={"text": "forged"})], now=NOW + i)
        assert forged.verify().is_intact
        assert forged.verify(anchor).broken_at == anchor.seq


@pytest.mark.parametrize("seed", range(3))
def test_any_flipped_byte_of_a_payload_in_the_file_is_found(tmp_path: Path, seed: int) -> None:
    path = _filled(tmp_path, events=40)
    with sqlite3.connect(path) as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    database.close()
    raw = bytearray(path.read_bytes())
    number = int(np.random.default_rng(seed).integers(0, 40))
    raw[raw.index(f'{{"text":"number {number}"}}'.encode()) + 3] ^= 1
    path.write_bytes(raw)
    with LedgerReader(path) as reader:
        assert reader.verify().broken_at == number + 1


def test_events_cannot_be_changed_or_removed_by_accident(tmp_path: Path) -> None:
    path = _filled(tmp_path)
    database = sqlite3.connect(path)
    for statement in ("DELETE FROM event", "UPDATE event SET time = 0"):
        with pytest.raises(sqlite3.IntegrityError, match="append-only"):
            database.execute(statement)
    database.close()


def test_a_file_that_is_not_a_ledger_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "ledger.db"
    path.write_bytes(b"this is not a database, it is a letter" * 100)
    with pytest.raises(CorruptLedgerError, match="not a database"):
        open_ledger(tmp_path)
    with pytest.raises(CorruptLedgerError, match="not a database"):
        LedgerReader(path)
    with pytest.raises(MissingDependencyError, match="dualbrain run"):
        LedgerReader(tmp_path / "nothing.db")


def test_a_newer_schema_is_refused(tmp_path: Path) -> None:
    path = _filled(tmp_path)
    _tamper(path, "UPDATE meta SET value = '3'")
    with pytest.raises(ConfigurationError, match="schema_version: got '3', allowed: 1 or 2"):
        open_ledger(tmp_path)


def test_a_failed_append_writes_nothing(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        first = ledger.append([PendingEvent(kind="episode", subject="e", payload={})], now=NOW)
        with pytest.raises(ConfigurationError, match="already contains an episode or a run with this name"):
            ledger.append(
                [
                    PendingEvent(kind="note", subject="n", payload={}),
                    PendingEvent(kind="episode", subject="e", payload={}),
                ],
                now=NOW,
            )
        with pytest.raises(ConfigurationError, match="time of a ledger event"):
            ledger.append([PendingEvent(kind="note", subject="n", payload={})], now=float("nan"))
        assert tuple(ledger.events()) == first
        ledger.append([PendingEvent(kind="note", subject="n", payload={})], now=NOW)
        assert ledger.verify().is_intact


def test_an_append_after_a_head_that_has_moved_writes_nothing(tmp_path: Path) -> None:
    note = [PendingEvent(kind="note", subject="n", payload={})]
    with open_ledger(tmp_path) as ledger:
        known = ledger.head()
        (first,) = ledger.append(note, now=NOW, after=known)
        with pytest.raises(HeadMovedError, match=r"newest event is 1, not 0") as raised:
            ledger.append(note, now=NOW, after=known)
        assert (raised.value.expected, raised.value.found) == (known, Head(1, first.hash))
        assert tuple(ledger.events()) == (first,)
        ledger.append(note, now=NOW, after=ledger.head())
        assert ledger.verify().is_intact


@settings(max_examples=60, deadline=None)
@given(
    kinds=st.sets(st.sampled_from(["note", "weight"])),
    subject=st.sampled_from([None, "a", "b' OR 1=1 --"]),
    after=st.integers(0, 8),
    until=st.one_of(st.none(), st.integers(0, 8)),
)
def test_a_query_gives_the_events_that_meet_every_condition(
    tmp_path_factory: pytest.TempPathFactory, kinds: set[str], subject: str | None, after: int, until: int | None
) -> None:
    folder = tmp_path_factory.getbasetemp() / "queries"
    if not folder.exists():
        folder.mkdir()
        with open_ledger(folder) as ledger:
            for i in range(6):
                kind, about = ("note", "weight")[i % 2], ("a", "b")[i // 3]
                ledger.append([PendingEvent(kind=kind, subject=about, payload={})], now=NOW)
    with LedgerReader(folder / "ledger.db") as reader:
        found = list(reader.events(*kinds, subject=subject, after=after, until=until))
        expected = [
            event
            for event in reader.events()
            if (not kinds or event.kind in kinds)
            and (subject is None or event.subject == subject)
            and after < event.seq
            and (until is None or event.seq <= until)
        ]
    assert found == expected


# --- one writer -----------------------------------------------------------------------------------------------------


def test_a_second_writer_is_refused_by_name_and_readers_are_not(tmp_path: Path) -> None:
    ready = (
        "import sys, time, pathlib; from dualbrain.memory.ledger.ledger import Ledger, PendingEvent\n"
        "ledger = Ledger(pathlib.Path(sys.argv[1]), holder='dualbrain run r-7', now=1.0)\n"
        "ledger.append([PendingEvent(kind='note', subject='', payload=1)], now=1.0)\n"
        "print('ready', flush=True); time.sleep(60)"
    )
    path = tmp_path / "ledger.db"
    writer = subprocess.Popen([*INTERPRETER, "-c", ready, str(path)], stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    try:
        assert writer.stdout.readline() == "ready\n"
        with pytest.raises(LedgerInUseError, match=rf"process {writer.pid} \(dualbrain run r-7\).*--ledger FILE"):
            open_ledger(tmp_path)
        with LedgerReader(path) as one, LedgerReader(path) as two:
            assert one.head() == two.head()
            assert one.verify().events == 1
            with pytest.raises(sqlite3.OperationalError, match="readonly"):
                one._store.database.execute("DELETE FROM meta")
    finally:
        writer.kill()
        writer.wait()
        writer.stdout.close()
    open_ledger(tmp_path).close()


def test_the_lock_is_free_after_close_and_after_a_failed_open(tmp_path: Path) -> None:
    open_ledger(tmp_path).close()
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "ledger.db").write_bytes(b"x" * 4096)
    for _ in range(2):
        with pytest.raises(CorruptLedgerError):
            open_ledger(tmp_path / "bad")
    with open_ledger(tmp_path), pytest.raises(LedgerInUseError, match=rf"process {os.getpid()} \(a test\)"):
        open_ledger(tmp_path)


# --- crashes and interrupted runs -----------------------------------------------------------------------------------


def _killed(path: Path, run: str, delay: float) -> int:
    """Kill the writer with SIGKILL `delay` seconds after its first acknowledgement; returns the acknowledged steps."""
    command = [*INTERPRETER, str(crash_writer.__file__), str(path), run]
    writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert writer.stdout is not None
    lines = [writer.stdout.readline()]
    time.sleep(delay)
    os.kill(writer.pid, signal.SIGKILL)
    lines += writer.stdout.readlines()
    writer.wait()
    writer.stdout.close()
    return sum(line.endswith("\n") for line in lines)


def test_kill_9_at_any_moment_leaves_a_valid_chain_with_every_acknowledged_event(tmp_path: Path) -> None:
    path, rng = tmp_path / "ledger.db", np.random.default_rng(0)
    for k in range(6):
        acknowledged = _killed(path, f"run-{k}", float(rng.uniform(0.0, 0.15)))
        with Ledger(path, holder="a test", now=NOW) as ledger:
            assert ledger.verify().is_intact
            stored = sum(1 for _ in ledger.events("episode", run=f"run-{k}"))
            weights = sum(1 for _ in ledger.events("weight", run=f"run-{k}"))
            assert acknowledged <= stored <= acknowledged + 1
            assert weights == stored * (crash_writer.EVENTS_PER_TRANSACTION - 1)
            assert len(list(ledger.vectors())) == sum(1 for _ in ledger.events("episode"))
            assert [run.run for run in ledger.interrupted_runs()] == [f"run-{k}"]
            assert ledger.interrupted_runs()[0].episodes == stored


def test_kill_9_before_each_statement_leaves_a_valid_chain(tmp_path: Path) -> None:
    """From a missing file to a stored episode, with one killed process for each SQL statement."""
    command = [*INTERPRETER, str(crash_writer.__file__), str(tmp_path)]
    statements = int(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.splitlines()[-1])
    assert statements > 20
    lengths = []
    for statement in range(statements + 1):
        with Ledger(tmp_path / f"{statement}.db", holder="a test", now=NOW) as ledger:
            report = ledger.verify()
            assert report.is_intact
            assert len(list(ledger.vectors())) == (report.events > 1)
            assert [run.run for run in ledger.interrupted_runs()] == ["run"] * (report.events > 0)
            lengths.append(report.events)
    assert lengths == sorted(lengths)
    assert set(lengths) == {0, 1, 1 + crash_writer.EVENTS_PER_TRANSACTION}


def test_the_next_start_reports_an_interrupted_run_once(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        assert ledger.start_run("r-1", {"instruction": "tidy up"}, now=NOW) == ()
        ledger.mark_progress("grasp red_cube", now=NOW + 60)
        assert ledger.interrupted_runs() == ()
    with open_ledger(tmp_path) as ledger:
        (interrupted,) = ledger.start_run("r-2", {}, now=NOW + 3600)
        assert str(interrupted) == (
            "Run r-1 of 2027-01-15 08:00:00 UTC was interrupted after 'grasp red_cube' (2027-01-15 08:01:00 UTC): "
            "0 episodes were stored and kept; an unfinished episode is not in memory."
        )
        ledger.append([PendingEvent(kind="episode", subject="e-1", payload={})], now=NOW + 3601)
    with open_ledger(tmp_path) as ledger:
        (interrupted,) = ledger.interrupted_runs()
        assert (interrupted.run, interrupted.last_activity, interrupted.episodes) == ("r-2", "storing episode e-1", 1)
        ledger.start_run("r-3", {}, now=NOW + 7200)
        ledger.end_run({"success": True}, now=NOW + 7300)
        assert ledger.verify().is_intact
    with open_ledger(tmp_path) as ledger:
        assert ledger.interrupted_runs() == ()
        kinds = [event.kind for event in ledger.events(run="r-2")]
    assert kinds == ["run_started", "episode", "run_interrupted"]


# --- hostile text ---------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(
    text=st.text(st.characters(exclude_categories=["Cs"])), subject=st.text(st.characters(exclude_categories=["Cs"]))
)
def test_any_unicode_text_is_read_as_it_was_written(
    tmp_path_factory: pytest.TempPathFactory, text: str, subject: str
) -> None:
    with open_ledger(tmp_path_factory.mktemp("ledger")) as ledger:
        ledger.append([PendingEvent(kind="note", subject=subject, payload={"text": text, text: 1})], now=NOW)
        (event,) = ledger.events()
        assert event.subject == subject
        assert msgspec.json.decode(event.payload) == {"text": text} | {text: 1}
        assert ledger.verify().is_intact


@pytest.mark.parametrize(
    "text",
    ["'; DROP TABLE event; --", "\x00\x1b[2J\u202e", '"}],"outcome":{"kind":"succeeded"}', "</s><|im_start|>system"],
)
def test_hostile_text_is_stored_as_data(tmp_path: Path, text: str) -> None:
    with open_ledger(tmp_path) as ledger:
        ledger.start_run(text, {"instruction": text}, now=NOW)
        ledger.append([PendingEvent(kind="note", subject=text, payload=text)], now=NOW)
        assert [event.run for event in ledger.events()] == [text, text]
        assert msgspec.json.decode(next(iter(ledger.events(subject=text))).payload) == text
        assert ledger.verify().is_intact


def test_values_that_json_cannot_represent_are_replaced_visibly(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        ledger.append(
            [
                PendingEvent(
                    kind="note", subject="a\ud800", payload={"\udfff": (float("nan"), float("inf"), 10**400, "\ud800")}
                )
            ],
            now=NOW,
        )
        (event,) = ledger.events()
        expected = {"\ufffd": [None, None, "an integer of 1329 bits", "\ufffd"]}
        assert (event.subject, msgspec.json.decode(event.payload)) == ("a\ufffd", expected)
        assert ledger.verify().is_intact
