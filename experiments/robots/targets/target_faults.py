"""Fault injection with filter and supervisor on an emulated board: each source and kind on each robot."""

from __future__ import annotations

from itertools import product
from typing import Any

import msgspec

from dualbrain.evaluation.fault_injection.faults import HOST_SOURCES, KINDS, MOBILE_BASE_MOMENTS, MOMENTS, TARGET, Fault
from dualbrain.evaluation.fault_injection.trial import COMMANDER_SOURCES, run_fault_trial
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.target.boards import BOARDS
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table
from experiments.gatekeeper.fault_tables import summary
from experiments.gatekeeper.faults import ARMS, ROOMS, SCENES

ROBOTS = (*(robot for robot in ARMS if robot != "fr3"), "base")
SOURCES = (*(source for source in HOST_SOURCES if source not in COMMANDER_SOURCES), TARGET)
"""Sources in front of a gatekeeper are left out, because a gatekeeper does not use a target."""
HOST_FILTER = "qp"
"""The source whose faults change the results of the host's filter, behind the kernels that are compared."""


class TargetFaults:
    """The declared action follows on host and target, nothing is unsafe, and no bit differs without a faulty filter."""

    name = "target_faults"
    claim = (
        "With filter and supervisor on an emulated board, at least the declared action follows after every fault of "
        "joint states, scene, clock, filter, drive and the link to the board, and the independent monitor reports no "
        "violation. The strongest action of the board's supervisor is at least the host's wherever it is asked, and no "
        "control has another bit than the host's, except after faults of the host's filter itself."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """6 sources × 7 kinds × 3 robots = 126; moments, scenes and boards alternate."""
        del options
        found = list[WorkUnit]()
        axes = (range(len(KINDS)), range(len(SOURCES)), range(len(ROBOTS)))
        for k, s, r in product(*axes):
            moments, scenes = (MOBILE_BASE_MOMENTS, ROOMS) if ROBOTS[r] == "base" else (MOMENTS, SCENES)
            fault = [SOURCES[s], KINDS[k], moments[(2 * s + k + r) % len(moments)]]
            scene, board = scenes[(s + k) % len(scenes)], tuple(BOARDS)[(s + 2 * k + r) % len(BOARDS)]
            key = "/".join((ROBOTS[r], *fault, scene, board))
            found.append(WorkUnit(key, {"body": ROBOTS[r], "fault": fault, "scene": scene, "board": board}))
        return found

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run one episode on a board with an injected fault."""
        report = run_fault_trial(
            Fault(*parameters["fault"]),
            robot=parameters["body"],
            scene=parameters["scene"],
            target=parameters["board"],
        )
        found = {**msgspec.to_builtins(report), "safe": report.safe, "as_declared": report.as_declared}
        return {**found, "body": parameters["body"], "fault": parameters["fault"], "board": parameters["board"]}

    def summarize_row(self, row: Row) -> str:
        """Summarize the row for the progress line."""
        good, target = "safe" if row["safe"] else "UNSAFE", row["target"]
        different = f"{target['differences']} of {target['steps']} steps differ"
        return f"{good}, expected {row['expected']}, host {row['reached']}, board {target['reached']}, {different}"

    def report(self, rows: list[Row]) -> list[str]:
        """The summary, a table by board and one by fault, and each failed episode by name."""
        bad = [row for row in rows if not (row["safe"] and row["as_declared"] and agrees(row))]
        failed = [f"- {row['key']}: {self.summarize_row(row)}; {row['reason']}; {row['unsafe']}" for row in bad]
        different = [
            f"- {row['key']}: {row['target']['differences']} of {row['target']['steps']} steps with other bits"
            for row in rows
            if row["target"]["differences"]
        ]
        heads = (
            "board",
            "episodes",
            "board decided as the host",
            "not asked after the fault",
            "steps",
            "other bits than the host",
        )
        by_board = [_board_row(board, [row for row in rows if row["board"] == board]) for board in BOARDS]
        fault_heads = ("fault", "declared", *(f"{robot}: host, board" for robot in ROBOTS))
        by_fault = [_fault_row(rows, source, kind) for source in SOURCES for kind in KINDS]
        return [
            *summary(rows),
            *markdown_table(heads, [row for row in by_board if row]),
            *markdown_table(fault_heads, by_fault),
            *different,
            *failed,
        ]


def agrees(row: Row) -> bool:
    """Whether the board decided as the host, and no bit differed; a board that was not asked any more agrees.

    A host whose own filter is faulty brakes by itself and continues from there, which the board may refuse.
    """
    target = row["target"]
    if target["differences"] and row["fault"][0] != HOST_FILTER:
        return False
    if target["lost"]:
        return row["fault"][0] == TARGET
    if not target["answers"]:  # the host ended with the fault
        return row["outcome"] in ("stopped", "emergency")
    return bool(SafetyAction[target["reached"]] >= least_of_host(row))


def _was_asked(row: Row) -> bool:
    """Whether the board could decide about the fault: its link did not fail, and the host went on."""
    return bool(row["target"]["answers"]) and not row["target"]["lost"]


def least_of_host(row: Row) -> SafetyAction:
    """The action that a board must reach: that of the host, without warnings, which a board does not decide."""
    reached = SafetyAction[row["reached"]]
    return reached if reached > SafetyAction.WARN and row["struck"] is not None else SafetyAction.NONE


def _board_row(board: str, rows: list[Row]) -> tuple[object, ...]:
    if not rows:
        return ()
    answered = [row for row in rows if _was_asked(row)]
    steps, different = (sum(row["target"][name] for row in rows) for name in ("steps", "differences"))
    decided = format_proportion(sum(map(agrees, answered)), len(answered)) if answered else "–"
    return f"{BOARDS[board].core} ({board})", len(rows), decided, len(rows) - len(answered), steps, different


def _fault_row(rows: list[Row], source: str, kind: str) -> tuple[str, ...]:
    found = {row["body"]: row for row in rows if row["fault"][:2] == [source, kind]}
    declared = sorted({row["expected"] for row in found.values()}, key=lambda name: SafetyAction[name])
    return f"{source} {kind}", " or ".join(declared), *(_cell(found.get(robot)) for robot in ROBOTS)


def _cell(row: Row | None) -> str:
    if row is None:
        return "…"
    if row["struck"] is None:
        return "–"
    board = row["target"]["reached"] if _was_asked(row) else "not asked"
    marks = ("" if row["safe"] else " UNSAFE") + ("" if row["as_declared"] and agrees(row) else " ≠")
    return f"{row['reached']}, {board}{marks}"
