"""Anchors beside the ledger and in run folders reveal a ledger that was shortened, rewritten or replaced."""

import json
import os
import shutil
import sqlite3
import stat
from pathlib import Path

import pytest

from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.memory.ledger.anchors import RUN_ANCHOR_FILE, AnchorMismatchError, anchor_path, check_anchors
from dualbrain.memory.ledger.hash_chain import CorruptLedgerError
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, PendingEvent
from dualbrain.memory.maintenance.acceptance import accept_ledger
from dualbrain.memory.maintenance.compaction import compact_in_place
from dualbrain.memory.maintenance.verification import verify
from tests.memory.memory_samples import NOW

NOTE = PendingEvent(kind="note", subject="s", payload={})


def run(folder: Path, name: str, events: int = 2, *, now: float = NOW) -> Path:
    """A run in `folder`/runs/`name` that appends `events` notes; returns its folder."""
    out = folder / "runs" / name
    out.mkdir(parents=True)
    with Ledger(folder / "ledger.db", holder="a test", now=now, run_folders=(out.parent,)) as ledger:
        ledger.start_run(name, {}, now=now)
        ledger.anchor(out / RUN_ANCHOR_FILE)
        for _ in range(events):
            ledger.append([NOTE], now=now)
        ledger.end_run({}, now=now)
        ledger.anchor(out / RUN_ANCHOR_FILE)
    return out


def save(folder: Path) -> Path:
    shutil.copytree(folder, folder.with_name(f"{folder.name}-saved"), ignore=shutil.ignore_patterns("runs"))
    return folder.with_name(f"{folder.name}-saved")


def restore(folder: Path, names: tuple[str, ...]) -> None:
    """Replace files of `folder` by the saved ones."""
    for name in names:
        shutil.copy2(folder.with_name(f"{folder.name}-saved") / name, folder / name)


def cut(folder: Path) -> None:
    """Remove the newest two events and leave everything else valid."""
    database = sqlite3.connect(folder / "ledger.db", isolation_level=None)
    (trigger,) = database.execute("SELECT sql FROM sqlite_master WHERE name = 'event_is_never_removed'").fetchone()
    database.execute("DROP TRIGGER event_is_never_removed")
    database.execute("DELETE FROM event WHERE seq > (SELECT max(seq) FROM event) - 2")
    database.execute(trigger)
    database.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    home = tmp_path / "home"
    home.mkdir()
    run(home, "one")
    save(home)
    run(home, "two", now=NOW + 10)
    return home


def cut_the_newest_events(folder: Path) -> None:
    cut(folder)


def copy_an_older_ledger_back(folder: Path) -> None:
    restore(folder, ("ledger.db",))


def copy_an_older_ledger_and_its_anchor_back(folder: Path) -> None:
    restore(folder, ("ledger.db", "ledger.db.anchor"))


def cut_and_remove_the_anchor(folder: Path) -> None:
    cut(folder)
    anchor_path(folder / "ledger.db").unlink()


def replace_by_another_ledger(folder: Path) -> None:
    (folder / "ledger.db").unlink()
    with Ledger(folder / "forged.db", holder="a test", now=NOW) as ledger:
        for _ in range(20):
            ledger.append([NOTE], now=NOW)
    (folder / "forged.db").rename(folder / "ledger.db")


def replace_by_an_empty_ledger(folder: Path) -> None:
    (folder / "ledger.db").unlink()


def remove_ledger_and_anchor(folder: Path) -> None:
    (folder / "ledger.db").unlink()
    anchor_path(folder / "ledger.db").unlink()


def truncate(folder: Path) -> None:
    (folder / "ledger.db").write_bytes(b"")


LOSSES = (
    cut_the_newest_events,
    copy_an_older_ledger_back,
    copy_an_older_ledger_and_its_anchor_back,
    cut_and_remove_the_anchor,
    replace_by_another_ledger,
    replace_by_an_empty_ledger,
    remove_ledger_and_anchor,
    truncate,
)


@pytest.mark.parametrize("lose", LOSSES)
def test_a_loss_is_reported_at_once_and_accepted_only_by_command(folder: Path, lose) -> None:
    path, runs = folder / "ledger.db", folder / "runs"
    lose(folder)
    for _ in range(2):
        with pytest.raises(
            AnchorMismatchError, match=r"contained event \d+ at 2027.*Restore.*--accept REASON"
        ) as error:
            Ledger(path, holder="a test", now=NOW + 20, run_folders=(runs,))
        assert isinstance(error.value, CorruptLedgerError)
    report = accept_ledger(path, "a restored backup", holder="a test", now=NOW + 30, run_folders=(runs,))
    assert report.faults
    run(folder, "three", now=NOW + 40)
    with LedgerReader(path) as reader:
        found = verify(reader, run_folders=(runs,))
        assert found.is_intact, found
        assert [event.kind for event in reader.events("accepted")] == ["accepted"]


@pytest.mark.parametrize("lose", LOSSES[:5])
def test_verify_reports_the_loss(folder: Path, lose) -> None:
    lose(folder)
    with LedgerReader(folder / "ledger.db") as reader:
        found = verify(reader, run_folders=(folder / "runs",))
    assert found.chain.is_intact
    assert not found.is_intact
    assert "contained event" in found.anchor_faults[0]


def test_a_lost_write_ahead_log_is_reported(tmp_path: Path) -> None:
    with Ledger(tmp_path / "ledger.db", holder="a test", now=NOW) as ledger:
        ledger.append([NOTE], now=NOW)
        ledger.checkpoint_wal()
        ledger.append([NOTE], now=NOW)
        ledger.anchor()
        for name in ("ledger.db", "ledger.db.anchor"):  # the machine stops here, and the log is lost
            (tmp_path / "crashed").mkdir(exist_ok=True)
            shutil.copy2(tmp_path / name, tmp_path / "crashed" / name)
    with pytest.raises(AnchorMismatchError, match="now it ends at event 1"):
        Ledger(tmp_path / "crashed" / "ledger.db", holder="a test", now=NOW)


def test_an_untouched_ledger_passes_and_grows(folder: Path) -> None:
    run(folder, "three", now=NOW + 20)
    with LedgerReader(folder / "ledger.db") as reader:
        report = check_anchors(reader, (folder / "runs",))
    assert (report.compared, report.faults, report.notices) == (4, (), ())


def test_a_killed_writer_leaves_no_fault(tmp_path: Path) -> None:
    pid = os.fork()
    if not pid:
        ledger = Ledger(tmp_path / "ledger.db", holder="a test", now=NOW)
        ledger.append([NOTE, NOTE], now=NOW)
        os._exit(0)
    os.waitpid(pid, 0)
    with Ledger(tmp_path / "ledger.db", holder="a test", now=NOW) as ledger:
        assert (ledger.head().seq, ledger.notices) == (2, ())


def test_a_removed_anchor_is_noticed_while_run_folders_hold_anchors(folder: Path) -> None:
    anchor_path(folder / "ledger.db").unlink()
    runs = (folder / "runs",)
    with LedgerReader(folder / "ledger.db") as reader:
        (notice,) = check_anchors(reader, runs).notices
    assert "is missing: it was compared with 2 of its anchors in run folders" in notice
    with Ledger(folder / "ledger.db", holder="a test", now=NOW, run_folders=runs) as ledger:
        assert ledger.notices == (notice,)
    with Ledger(folder / "ledger.db", holder="a test", now=NOW) as ledger:
        assert ledger.notices == ()


@pytest.mark.parametrize(
    "content", [b"", b"{", b"[]", b"\xff", b'{"seq": -1, "hash": "", "time": 0, "ledger": ""}', b"[" * 100_000]
)
def test_a_damaged_anchor_is_refused(folder: Path, content: bytes) -> None:
    anchor_path(folder / "ledger.db").write_bytes(content)
    with pytest.raises(AnchorMismatchError, match="anchor of the memory ledger cannot be read"):
        Ledger(folder / "ledger.db", holder="a test", now=NOW)
    accept_ledger(folder / "ledger.db", "a test", holder="a test", now=NOW)
    Ledger(folder / "ledger.db", holder="a test", now=NOW).close()


@pytest.mark.parametrize("time", [1e300, -1e300, 0.0])
def test_an_anchor_with_an_absurd_time_is_reported(folder: Path, time: float) -> None:
    path = anchor_path(folder / "ledger.db")
    path.write_text(json.dumps({**json.loads(path.read_text()), "seq": 1 << 61, "time": time}))
    with pytest.raises(AnchorMismatchError, match="now it ends at event"):
        Ledger(folder / "ledger.db", holder="a test", now=NOW)


def test_the_anchor_beside_the_ledger_names_the_folders_of_runs(folder: Path) -> None:
    with LedgerReader(folder / "ledger.db") as reader:
        report = check_anchors(reader)
    assert (report.compared, report.run_folders) == (3, (str(folder / "runs"),))


def test_anchors_of_another_ledger_do_not_count(folder: Path) -> None:
    with Ledger(folder / "other.db", holder="a test", now=NOW, run_folders=(folder / "runs",)) as ledger:
        assert ledger.anchor_report.compared == 0


def test_a_broken_chain_cannot_be_accepted(folder: Path) -> None:
    database = sqlite3.connect(folder / "ledger.db", isolation_level=None)
    database.execute("DROP TRIGGER event_is_never_changed")
    database.execute("UPDATE event SET time = time + 1 WHERE seq = 2")
    database.close()
    with pytest.raises(CorruptLedgerError, match="at event 2"):
        accept_ledger(folder / "ledger.db", "a test", holder="a test", now=NOW)
    with pytest.raises(ConfigurationError, match="The reason is empty"):
        accept_ledger(folder / "ledger.db", "  ", holder="a test", now=NOW)


def test_a_compacted_ledger_is_compared_through_its_archive(folder: Path) -> None:
    path, runs = folder / "ledger.db", folder / "runs"
    archive = compact_in_place(path, holder="a test", now=NOW + 20, timeout_s=0.0)
    with LedgerReader(path) as reader:
        report = check_anchors(reader, (runs,))
        assert (report.faults, report.notices) == ((), ())
        assert report.compared == 3
    run(folder, "three", now=NOW + 30)
    with LedgerReader(path) as reader:
        assert check_anchors(reader, (runs,)).faults == ()
    archive.unlink()
    with LedgerReader(path) as reader:
        report = check_anchors(reader, (runs,))
    assert report.faults == ()
    assert "the archive of the compaction is missing" in report.notices[0]


def test_a_cut_compacted_ledger_is_reported(folder: Path) -> None:
    compact_in_place(folder / "ledger.db", holder="a test", now=NOW + 20, timeout_s=0.0)
    run(folder, "three", now=NOW + 30)
    cut(folder)
    with pytest.raises(AnchorMismatchError):
        Ledger(folder / "ledger.db", holder="a test", now=NOW + 40)


def test_a_missing_ledger_with_an_anchor_is_no_new_ledger(folder: Path) -> None:
    (folder / "ledger.db").unlink()
    with pytest.raises(MissingDependencyError, match="Its anchor shows that it existed"):
        LedgerReader(folder / "ledger.db")


def test_files_of_the_ledger_are_private_with_every_umask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        out = run(tmp_path / "new", "one")
        with Ledger(tmp_path / "new" / "ledger.db", holder="a test", now=NOW) as ledger:
            ledger.append([NOTE], now=NOW)
            found = {file.name: stat.S_IMODE(file.stat().st_mode) for file in (tmp_path / "new").glob("ledger*")}
    finally:
        os.umask(before)
    assert len(found) == 5
    assert set(found.values()) == {0o600}
    assert stat.S_IMODE((out / RUN_ANCHOR_FILE).stat().st_mode) == 0o600


def test_permissions_of_an_older_ledger_are_tightened(folder: Path) -> None:
    for file in folder.glob("ledger*"):
        file.chmod(0o644)
    Ledger(folder / "ledger.db", holder="a test", now=NOW).close()
    assert {stat.S_IMODE(file.stat().st_mode) for file in folder.glob("ledger*")} == {0o600}
    (folder / "ledger.db").chmod(0o666)
    LedgerReader(folder / "ledger.db").close()
    assert stat.S_IMODE((folder / "ledger.db").stat().st_mode) == 0o600
