"""The matrix of injected faults: complete, declared beforehand, and told as it was."""

from collections import Counter
from itertools import product

from dualbrain.evaluation.fault_injection.faults import EXPECTED_ACTIONS, KINDS, MOBILE_BASE_MOMENTS, MOMENTS, SOURCES
from experiments.engine.experiment import Options
from experiments.gatekeeper.fault_tables import fault_matrices, summary
from experiments.gatekeeper.faults import ARMS, ROOMS, Faults


def row(body="panda", fault=("state", "off", "carrying"), **changes):
    usual = {
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
    return {**usual, **changes}


def test_every_fault_at_every_moment_on_every_body_once_and_every_scene_alike(tmp_path):
    units = Faults().units(Options(tmp_path, "nobody"))
    abouts = [unit.parameters for unit in units]
    on_wheels = set(product(("base",), SOURCES, KINDS, MOBILE_BASE_MOMENTS))
    assert {(one["body"], *one["fault"]) for one in abouts} == set(product(ARMS, SOURCES, KINDS, MOMENTS)) | on_wheels
    assert len(units) == 882 + 98 >= 500
    met = Counter((one["body"] == "base", *one["fault"][:2], one["body"], one["scene"]) for one in abouts)
    assert {(key[0], count) for key, count in met.items()} == {(False, 2), (True, 1)}
    assert {one["scene"] for one in abouts if one["body"] == "base"} == set(ROOMS)
    early = abouts[:60]
    assert {one["body"] for one in early} == {*ARMS, "base"}
    assert {one["fault"][0] for one in early} == set(SOURCES)


def test_one_unit_on_another_body():
    proof = Faults()
    found = proof.run({"body": "ur5e", "scene": "bare:0", "fault": ["drive", "off", "closing"]})
    assert (found["safe"], found["as_declared"]) == (True, True)
    assert (found["expected"], found["body"]) == (EXPECTED_ACTIONS["drive", "off"].name, "ur5e")
    assert found["struck"] is not None
    assert proof.summarize_row(found).startswith("safe, expected ESTOP, reached")


def test_what_went_wrong_stands_out_and_is_counted():
    rows = [
        row(),
        row(fault=("state", "off", "closing"), struck=None),
        row(fault=("state", "off", "grasping"), safe=False),
        row("ur5e", as_declared=False, reached="NONE", reaction=None, outcome="succeeded"),
    ]
    text = "\n".join(Faults().report(rows))
    assert (
        "Episodes: **4**, of which 3 reached their moment. Unsafe: **1**. Declared order did not come: **1**." in text
    )
    assert "- panda/state/off/grasping: UNSAFE" in text
    assert "- ur5e/state/off/carrying: safe, expected HOLD, reached NONE" in text
    assert "| body panda | 3 | 2 | 1 | 0 | stopped 2 |" in summary(rows)
    tables = fault_matrices(rows)
    assert tables[0] == "### panda"
    assert "| state off | HOLD | – | … | STOP UNSAFE | STOP | … | … | 50 ms | 400 ms |" in tables
    assert "| state off | HOLD | … | … | … | NONE ≠ | … | … | – | – |" in tables
    wheels = fault_matrices([row("base", ("qp", "off", "closing"), expected="ESTOP", reached="ESTOP")])
    assert wheels[2] == "| fault | declared | closing | acknowledgement | reaction, worst | at rest after, worst |"
    assert "| qp off | ESTOP | ESTOP | … | 50 ms | 400 ms |" in wheels
