"""Fault injection: the units cover the whole matrix, and the tables count and list each failure."""

from collections import Counter
from itertools import product

from dualbrain.evaluation.fault_injection.faults import (
    EXPECTED_ACTIONS,
    HOST_SOURCES,
    KINDS,
    MOBILE_BASE_MOMENTS,
    MOMENTS,
)
from experiments.engine.experiment import Options
from experiments.gatekeeper.fault_tables import fault_matrices, summary
from experiments.gatekeeper.faults import ARMS, ROOMS, Faults


def row(body="panda", fault=("state", "off", "carrying"), **changes):
    default = {
        "key": "/".join((body, *fault)),
        "body": body,
        "fault": list(fault),
        "struck": 3.0,
        "expected": "HOLD",
        "reached": "CONTROLLED_STOP",
        "safe": True,
        "as_declared": True,
        "reaction": 0.05,
        "rest": 0.4,
        "outcome": "stopped",
        "reason": "",
        "unsafe": [],
    }
    return {**default, **changes}


def test_units_cover_each_fault_moment_and_robot_once_and_scenes_evenly(tmp_path):
    units = Faults().units(Options(tmp_path, "some-planner"))
    parameters = [unit.parameters for unit in units]
    mobile = set(product(("base",), HOST_SOURCES, KINDS, MOBILE_BASE_MOMENTS))
    assert {(one["body"], *one["fault"]) for one in parameters} == set(
        product(ARMS, HOST_SOURCES, KINDS, MOMENTS)
    ) | mobile
    assert len(units) == 882 + 98 >= 500
    counts = Counter((one["body"] == "base", *one["fault"][:2], one["body"], one["scene"]) for one in parameters)
    assert {(key[0], count) for key, count in counts.items()} == {(False, 2), (True, 1)}
    assert {one["scene"] for one in parameters if one["body"] == "base"} == set(ROOMS)
    early = parameters[:60]
    assert {one["body"] for one in early} == {*ARMS, "base"}
    assert {one["fault"][0] for one in early} == set(HOST_SOURCES)


def test_one_unit_on_another_robot():
    experiment = Faults()
    found = experiment.run({"body": "ur5e", "scene": "bare:0", "fault": ["drive", "off", "closing"]})
    assert (found["safe"], found["as_declared"]) == (True, True)
    assert (found["expected"], found["body"]) == (EXPECTED_ACTIONS["drive", "off"].name, "ur5e")
    assert found["struck"] is not None
    assert experiment.summarize_row(found).startswith("safe, expected ESTOP, reached")


def test_unsafe_and_undeclared_results_are_counted_and_listed():
    rows = [
        row(),
        row(fault=("state", "off", "closing"), struck=None),
        row(fault=("state", "off", "grasping"), safe=False),
        row("ur5e", as_declared=False, reached="NONE", reaction=None, outcome="succeeded"),
    ]
    lines = Faults().report(rows)
    text = "\n".join(lines)
    assert (
        "Episodes: **4**, in 3 of which the fault was injected. Unsafe: **1**. Without the declared action: **1**."
        in text
    )
    assert "- panda/state/off/grasping: UNSAFE" in text
    assert "- ur5e/state/off/carrying: safe, expected HOLD, reached NONE" in text
    assert "| robot panda | 3 | 2 | 1 | 0 | stopped 2 |" in summary(rows)
    tables = fault_matrices(rows)
    assert lines[-len(tables) :] == tables
    assert tables[0] == "### panda"
    assert "| state off | HOLD | – | … | STOP UNSAFE | STOP | … | … | 50 ms | 400 ms |" in tables
    assert "| state off | HOLD | … | … | … | NONE ≠ | … | … | – | – |" in tables
    mobile = fault_matrices([row("base", ("qp", "off", "closing"), expected="ESTOP", reached="ESTOP")])
    assert mobile[2] == "| fault | declared | closing | acknowledgement | reaction, longest | until rest, longest |"
    assert "| qp off | ESTOP | ESTOP | … | 50 ms | 400 ms |" in mobile
