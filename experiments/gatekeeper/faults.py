"""Fault injection: source × kind × moment × robot, each with the action declared in advance."""

from __future__ import annotations

from itertools import product
from typing import Any

import msgspec

from dualbrain.evaluation.fault_injection.faults import HOST_SOURCES, KINDS, MOBILE_BASE_MOMENTS, MOMENTS, Fault
from dualbrain.evaluation.fault_injection.trial import run_fault_trial
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.gatekeeper.fault_tables import fault_matrices, summary

ARMS = ("panda", "ur5e", "fr3")
SCENES = ("bare:0", "tabletop:1", "forearm:0")
"""Only the task objects; obstacles beside them; a human forearm that crosses."""
ROOMS = ("boxes:0", "crossing:1")
"""Crates in the path of the base; a person who crosses it."""


class Faults:
    """No violation and at least the declared action after each fault at each of the worst moments."""

    name = "faults"
    claim = (
        "After every fault of every source, injected at the worst moments, on each arm and on a mobile base, the "
        "supervisor takes at least the declared action, and the independent monitor reports no violation."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """7 sources × 7 kinds × (6 moments × 3 arms + 2 moments of a base) = 980; any prefix covers all sources.

        The scenes alternate as in a Latin square: every fault occurs in each scene at two moments on each arm; on the
        base it occurs once with crates and once with a person.
        """
        del options
        arms, base = (
            _interleaved_units(ARMS, MOMENTS, SCENES),
            _interleaved_units(("base",), MOBILE_BASE_MOMENTS, ROOMS),
        )
        placed = [(k / len(group), unit) for group in (arms, base) for k, unit in enumerate(group)]
        return [unit for _, unit in sorted(placed, key=lambda one: one[0])]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run one episode with an injected fault."""
        report = run_fault_trial(Fault(*parameters["fault"]), robot=parameters["body"], scene=parameters["scene"])
        found = {**msgspec.to_builtins(report), "safe": report.safe, "as_declared": report.as_declared}
        return {**found, "body": parameters["body"], "fault": parameters["fault"]}

    def summarize_row(self, row: Row) -> str:
        """Summarize the row for the progress line."""
        good = "safe" if row["safe"] else "UNSAFE"
        return f"{good}, expected {row['expected']}, reached {row['reached']}, {row['outcome']}"

    def report(self, rows: list[Row]) -> list[str]:
        """Report the summary, each failed episode by name, and the matrix per robot."""
        bad = [row for row in rows if not (row["safe"] and row["as_declared"])]
        failed = [f"- {row['key']}: {self.summarize_row(row)}; {row['reason']}; {row['unsafe']}" for row in bad]
        return [*summary(rows), *failed, *([""] if failed else []), *fault_matrices(rows)]


def _interleaved_units(robots: tuple[str, ...], moments: tuple[str, ...], scenes: tuple[str, ...]) -> list[WorkUnit]:
    """Return each combination once, ordered so that successive units differ in every axis."""
    cells = list(product(*(range(len(axis)) for axis in (robots, moments, KINDS, HOST_SOURCES))))
    order = sorted(range(len(cells)), key=lambda k: (k * 283) % len(cells))
    found: list[WorkUnit] = []
    for robot, moment, kind, source in (cells[k] for k in order):
        scene = scenes[(robot + moment + kind + source) % len(scenes)]
        fault = [HOST_SOURCES[source], KINDS[kind], moments[moment]]
        parameters = {"body": robots[robot], "scene": scene, "fault": fault}
        found.append(WorkUnit("/".join((robots[robot], *fault, scene)), parameters))
    return found
