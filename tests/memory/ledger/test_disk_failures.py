"""A full disk, a read-only disk and killed clients: clear errors, and no acknowledged event is lost."""

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, PendingEvent
from experiments.memory.crash_recovery import check_ledger, run_round
from tests.memory.memory_samples import NOW, REST_POSTURE, episode, open_ledger, open_memory


def _mounted(folder: Path, *options: str) -> bool:
    command = ["mount", "-t", "tmpfs", *options, "tmpfs", str(folder)]
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 4 MB; needs the permission to mount."""
    if not _mounted(tmp_path, "-o", "size=4m"):
        pytest.skip("this user may not mount a file system")
    yield tmp_path
    subprocess.run(["umount", "-l", str(tmp_path)], check=True)


def test_a_full_disk_is_reported_and_acknowledged_events_stay(small_disk: Path) -> None:
    kept = []
    with open_ledger(small_disk) as ledger:
        memory = open_memory(ledger)
        with pytest.raises(ConfigurationError, match=r"memory ledger .* cannot be used: .*(full|disk I/O).*free space"):  # noqa: PT012
            for i in range(3000):
                memory.store(episode(f"e-{i}", proposed="x" * 9000), REST_POSTURE, now=NOW)
                kept.append(f"e-{i}")
        retrieved = memory.retrieve("put the red cube in the bowl", "", REST_POSTURE, "arm", "aaaa1111", k=3)
        assert len(retrieved.exemplars) == 3
    with LedgerReader(small_disk / "ledger.db") as reader:
        assert reader.verify().is_intact
        assert [event.subject for event in reader.events("episode")] == kept
        assert len(kept) > 20


def test_the_ledger_continues_when_space_is_free_again(small_disk: Path) -> None:
    ballast = small_disk / "ballast"
    with open_ledger(small_disk) as ledger:
        ledger.append([PendingEvent(kind="note", subject="", payload=1)], now=NOW)
        ballast.write_bytes(bytes(os.statvfs(small_disk).f_bavail * os.statvfs(small_disk).f_frsize))
        with pytest.raises(ConfigurationError, match="memory ledger"):
            ledger.append([PendingEvent(kind="note", subject="", payload="x" * 200_000)], now=NOW)
        ballast.unlink()
        ledger.append([PendingEvent(kind="note", subject="", payload=2)], now=NOW)
        assert (ledger.verify().is_intact, ledger.head().seq) == (True, 2)


def test_a_full_disk_at_the_start_is_reported(small_disk: Path) -> None:
    (small_disk / "ballast").write_bytes(bytes(4 << 20))
    for _ in range(2):
        with pytest.raises(ConfigurationError, match="memory ledger"):
            open_ledger(small_disk)


def test_a_read_only_file_system_is_reported_and_can_be_read(small_disk: Path) -> None:
    with open_ledger(small_disk) as ledger:
        open_memory(ledger).store(episode("a"), REST_POSTURE, now=NOW)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with pytest.raises(ConfigurationError, match=r"memory ledger .* cannot be used: Read-only file system\. Check"):
        Ledger(small_disk / "ledger.db", holder="a test", now=NOW)
    with LedgerReader(small_disk / "ledger.db") as reader:
        memory = open_memory(reader)
        found = memory.retrieve("put the red cube in the bowl", "", REST_POSTURE, "arm", "aaaa1111", k=3)
        assert [hit.episode_id for hit in found.exemplars] == ["a"]


def test_four_clients_killed_at_random_moments_lose_nothing(tmp_path: Path) -> None:
    """A sample of the experiment `crash_recovery`."""
    rng, acknowledged, path = np.random.default_rng(99), set[str](), tmp_path / "ledger.sqlite"
    for number in range(4):
        acknowledged |= run_round(path, number, rng)
        assert check_ledger(path, acknowledged) == ("", 0)
    assert acknowledged
