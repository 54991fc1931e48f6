"""Injected faults: source × kind × moment × body, each with the order that was declared beforehand."""

from __future__ import annotations

from itertools import product
from typing import Any

import msgspec

from dualbrain.evaluation.fault_injection.faults import KINDS, MOBILE_BASE_MOMENTS, MOMENTS, SOURCES, Fault
from dualbrain.evaluation.fault_injection.trial import run_fault_trial
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.gatekeeper.fault_tables import summary

ARMS = ("panda", "ur5e", "fr3")
SCENES = ("bare:0", "tabletop:1", "forearm:0")
"""Nothing but the errand; neighbours; a person's forearm that crosses."""
ROOMS = ("boxes:0", "crossing:1")
"""Crates on the way; a person who crosses it."""


class Faults:
    """Nothing unsafe, whatever breaks at the worst moment, and the declared order comes."""

    name = "faults"
    claim = (
        "Whatever breaks, in whatever way, at the worst moment, on each arm and on a base: the declared order (or a "
        "stronger one) comes, and the independent monitor sees nothing unsafe."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """7 sources × 7 kinds × (6 moments × 3 arms + 2 moments of a base) = 980; any prefix covers all sources.

        The scenes go round, as in a Latin square: every fault meets each of them at two moments on each arm, and the
        base meets crates and a person at one each.
        """
        del options
        arms, base = (
            _interleaved_units(ARMS, MOMENTS, SCENES),
            _interleaved_units(("base",), MOBILE_BASE_MOMENTS, ROOMS),
        )
        placed = [(k / len(group), unit) for group in (arms, base) for k, unit in enumerate(group)]
        return [unit for _, unit in sorted(placed, key=lambda one: one[0])]

    def run(self, about: dict[str, Any]) -> Row:
        """One injected episode."""
        report = run_fault_trial(Fault(*about["fault"]), robot=about["body"], scene=about["scene"])
        found = {**msgspec.to_builtins(report), "safe": report.safe, "as_declared": report.as_declared}
        return {**found, "body": about["body"], "fault": about["fault"]}

    def summarize_row(self, row: Row) -> str:
        """For the progress line."""
        good = "safe" if row["safe"] else "UNSAFE"
        return f"{good}, expected {row['expected']}, reached {row['reached']}, {row['outcome']}"

    def report(self, rows: list[Row]) -> list[str]:
        """By body and moment; every exception by name. The whole matrix has a page of its own."""
        bad = [row for row in rows if not (row["safe"] and row["as_declared"])]
        return summary(rows) + [
            f"- {row['key']}: {self.summarize_row(row)}; {row['reason']}; {row['unsafe']}" for row in bad
        ]


def _interleaved_units(bodies: tuple[str, ...], moments: tuple[str, ...], scenes: tuple[str, ...]) -> list[WorkUnit]:
    """Every cell once, in an order in which neighbours differ in everything."""
    cells = list(product(*(range(len(axis)) for axis in (bodies, moments, KINDS, SOURCES))))
    order = sorted(range(len(cells)), key=lambda k: (k * 283) % len(cells))
    found: list[WorkUnit] = []
    for body, moment, kind, source in (cells[k] for k in order):
        scene = scenes[(body + moment + kind + source) % len(scenes)]
        fault = [SOURCES[source], KINDS[kind], moments[moment]]
        about = {"body": bodies[body], "scene": scene, "fault": fault}
        found.append(WorkUnit("/".join((bodies[body], *fault, scene)), about))
    return found
