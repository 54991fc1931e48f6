"""Agreement of the kinematic twin with the full simulation: the same contract at the same place in both."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from dualbrain.contracts.verdict import Accepted
from dualbrain.runtime.assembly import CellOptions, SimulatedCell
from dualbrain.runtime.data_collection.exploration.explore import nth_place
from dualbrain.runtime.data_collection.exploration.place import Place
from dualbrain.runtime.data_collection.exploration.trial import TIME_LIMIT
from dualbrain.runtime.data_collection.exploration.twin_cell import make_twin_cell
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table

N_PLACES, SEED = 120, 901
ROBOTS = ("panda", "ur5e")
WORLDS = ("twin", "full")


class TwinAgreement:
    """Random alternatives at held-out places, executed in the twin and in the full simulation."""

    name = "twin_agreement"
    claim = (
        "A contract has the same outcome in the kinematic twin as in the full simulation, at a small part of the "
        "processor time. The twin has no contacts and forces; its outcomes only select contracts for the other."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """One unit per place and robot."""
        return [
            WorkUnit(f"{robot}/{index}", {"robot": robot, "index": index})
            for index in range(N_PLACES)
            for robot in ROBOTS
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Execute one alternative at one place in both worlds."""
        place = nth_place(parameters["robot"], "test", SEED, parameters["index"])
        contracts = place.contracts()
        name = str(np.random.default_rng([SEED, parameters["index"], 9]).choice(list(contracts)))
        row: Row = {"scene": place.scene_name, "family": place.spec.family, "alternative": name}
        for world in WORLDS:
            row[world] = _execute(place, contracts[name], world)
        return row

    def summarize_row(self, row: Row) -> str:
        """Outcome and duration in both worlds."""
        return ", ".join(f"{world} {row[world]['kind']} {row[world]['duration']:.1f} s" for world in WORLDS)

    def report(self, rows: list[Row]) -> list[str]:
        """Agreement by robot and family, and the differences of duration, Δ and cost."""
        executed = [row for row in rows if row["full"]["kind"] != "rejected"]
        groups = {
            **{robot: [row for row in executed if row["key"].startswith(robot)] for robot in ROBOTS},
            **{family: [row for row in executed if row["family"] == family] for family in _families(executed)},
        }
        headers = (
            "",
            "episodes",
            "same outcome",
            "success in the twin",
            "success in full",
            "Δ ≤ 0.0021 in both or none",
        )
        table = markdown_table(
            headers,
            [
                (
                    name,
                    str(len(some)),
                    format_proportion(sum(_same(row) for row in some), len(some)),
                    format_proportion(sum(_succeeded(row, "twin") for row in some), len(some)),
                    format_proportion(sum(_succeeded(row, "full") for row in some), len(some)),
                    format_proportion(sum(_is_clean(row, "twin") == _is_clean(row, "full") for row in some), len(some)),
                )
                for name, some in groups.items()
                if some
            ],
        )
        both = [row for row in executed if _succeeded(row, "twin") and _succeeded(row, "full")]
        ratio = np.median([row["twin"]["duration"] / row["full"]["duration"] for row in both])
        within = np.mean([abs(row["twin"]["duration"] / row["full"]["duration"] - 1.0) < 0.1 for row in both])
        cost = np.sum([row["full"]["cpu_s"] for row in executed]) / np.sum([row["twin"]["cpu_s"] for row in executed])
        per_hour = 3600.0 / np.mean([row["twin"]["cpu_s"] for row in executed])
        return [
            *table,
            "",
            f"Of {len(both)} successes in both, the duration in the twin is {ratio:.2f} of the other (median), within "
            f"10 % in {within:.0%}. The full simulation takes {cost:.1f} times the processor time of the twin, which "
            f"executes {per_hour:.0f} episodes per hour of one core, with the start-up of each.",
        ]


def _execute(place: Place, contract: str, world: str) -> dict[str, Any]:
    """The outcome in one world, and its processor time [s]."""
    start = time.process_time()
    cell = make_twin_cell(place.spec, time_limit=TIME_LIMIT) if world == "twin" else _full_cell(place)
    with cell:
        verdict = cell.check(contract)
        if not isinstance(verdict, Accepted):
            return {"kind": "rejected", "reason": verdict.hint, "duration": 0.0, "cpu_s": time.process_time() - start}
        outcome = cell.execute(verdict.contract)
    return {
        "kind": outcome.kind,
        "reason": outcome.reason,
        "Delta": outcome.Delta,
        "frequency": outcome.intervention_frequency,
        "duration": outcome.duration,
        "cpu_s": round(time.process_time() - start, 2),
    }


def _full_cell(place: Place) -> SimulatedCell:
    return SimulatedCell.make(place.spec.robot, place.spec, CellOptions(seed=0))


def _families(rows: Sequence[Row]) -> list[str]:
    return sorted({row["family"] for row in rows})


def _succeeded(row: Row, world: str) -> bool:
    return row[world]["kind"] == "succeeded"


def _same(row: Row) -> bool:
    return _succeeded(row, "twin") == _succeeded(row, "full")


def _is_clean(row: Row, world: str) -> bool:
    return _succeeded(row, world) and (row[world]["Delta"] or 0.0) <= 0.0021
