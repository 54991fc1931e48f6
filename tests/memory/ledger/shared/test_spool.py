"""The spool of a shared ledger: items in their order, and none that replaces another."""

from pathlib import Path

import pytest

from dualbrain.memory.ledger.shared.spool import Spool, WaitingItem


@pytest.fixture
def spool(tmp_path: Path) -> Spool:
    return Spool(tmp_path / "spool")


def contents(spool: Spool, suffix: str) -> dict[str, float]:
    """The time of each item by the name of its file."""
    return {file.name: spool.read(file).time for file in sorted(spool.folder.glob(f"*{suffix}"))}


def test_refused_items_are_all_kept(spool: Spool) -> None:
    for time in (1.0, 2.0, 3.0):
        spool.add(WaitingItem(time=time))
        spool.put_away(spool.files()[0])
    assert len(spool) == 0
    assert sorted(contents(spool, ".refused").values()) == [1.0, 2.0, 3.0]


def test_items_are_numbered_after_waiting_and_refused_ones(spool: Spool) -> None:
    for time in (1.0, 2.0):
        spool.add(WaitingItem(time=time))
    spool.put_away(spool.files()[1])
    spool.add(WaitingItem(time=3.0))
    assert contents(spool, ".json") == {"00000001.json": 1.0, "00000003.json": 3.0}


def test_a_refused_item_whose_number_is_taken_gets_the_next_one(spool: Spool) -> None:
    """Earlier versions gave the number of a refused item to a later one."""
    spool.add(WaitingItem(time=1.0))
    spool.put_away(spool.files()[0])
    (spool.folder / "00000001.refused").rename(spool.folder / "kept")
    spool.add(WaitingItem(time=2.0))
    (spool.folder / "kept").rename(spool.folder / "00000001.refused")
    assert spool.put_away(spool.files()[0]).name == "00000002.refused"
    assert contents(spool, ".refused") == {"00000001.refused": 1.0, "00000002.refused": 2.0}
