"""Faults with an emulated board: the units are balanced, and the tables count each disagreement."""

from collections import Counter
from itertools import product

import pytest

from dualbrain.evaluation.fault_injection.faults import KINDS
from dualbrain.safety.target.boards import BOARDS
from experiments.engine.experiment import Options
from experiments.robots.targets.target_faults import ROBOTS, SOURCES, TargetFaults, agrees
from tests.experiments.gatekeeper.test_faults import row


def board_row(body="panda", fault=("state", "off", "carrying"), *, board="an386", target=None, **changes):
    own = {
        "board": board,
        "answers": 9,
        "reached": "CONTROLLED_STOP",
        "drive_off": True,
        "steps": 100,
        "differences": 0,
        "lost": "",
    }
    found = row(body, fault, **changes) | {"board": board, "target": own | (target or {})}
    return found | {"key": f"{found['key']}/{board}"}


def test_units_have_every_fault_once_on_each_robot_and_boards_evenly(tmp_path):
    units = [unit.parameters for unit in TargetFaults().units(Options(tmp_path, "some-planner"))]
    assert Counter((one["body"], *one["fault"][:2]) for one in units) == Counter(product(ROBOTS, SOURCES, KINDS))
    assert {"planner", "socket"} & set(SOURCES) == set()
    assert set(Counter((one["body"], one["board"]) for one in units).values()) == {14}
    assert {(one["scene"], one["board"]) for one in units if one["body"] == "ur5e"} == set(
        product(("bare:0", "tabletop:1", "forearm:0"), BOARDS)
    )
    assert len({one["fault"][2] for one in units}) == 6


@pytest.mark.parametrize(
    ("changes", "agreed"),
    [
        ({}, True),
        ({"target": {"reached": "ESTOP"}}, True),
        ({"target": {"reached": "HOLD"}}, False),
        ({"target": {"differences": 1}}, False),
        ({"target": {"answers": 0, "reached": "NONE"}, "outcome": "succeeded"}, False),
        ({"target": {"answers": 0, "reached": "NONE"}}, True),
        (
            {"target": {"answers": 0, "lost": "no answer", "reached": "NONE"}, "fault": ("target", "off", "closing")},
            True,
        ),
        ({"target": {"lost": "no answer", "reached": "ESTOP"}}, False),
        ({"target": {"answers": 1, "reached": "NONE", "lost": "late"}, "fault": ("target", "off", "closing")}, True),
        ({"target": {"reached": "NONE"}, "reached": "WARN"}, True),
        ({"target": {"reached": "NONE"}, "struck": None}, True),
    ],
)
def test_a_board_agrees_if_it_decides_at_least_as_the_host(changes, agreed):
    assert agrees(board_row(**changes)) is agreed


def test_the_tables_count_boards_and_name_each_failure():
    rows = [
        board_row(),
        board_row("ur5e", target={"reached": "HOLD"}),
        board_row("base", safe=False, target={"differences": 3}, board="an500"),
        board_row(fault=("target", "off", "closing"), target={"answers": 0, "lost": "no answer", "reached": "NONE"}),
    ]
    text = "\n".join(TargetFaults().report(rows))
    assert "Unsafe: **1**." in text
    assert "| Cortex-M4F (an386) | 3 | 1 of 2 (9%–91%) | 1 | 300 | 0 |" in text
    assert "| Cortex-M7 (an500) | 1 | 0 of 1 (0%–79%) | 0 | 100 | 3 |" in text
    cells = "CONTROLLED_STOP, CONTROLLED_STOP | CONTROLLED_STOP, HOLD ≠ | CONTROLLED_STOP, CONTROLLED_STOP UNSAFE ≠ |"
    assert f"| state off | HOLD | {cells}" in text
    assert "| target off | HOLD | CONTROLLED_STOP, not asked | … | … |" in text
    assert "- base/state/off/carrying/an500: UNSAFE, expected HOLD" in text
    assert "3 of 100 steps differ" in text
