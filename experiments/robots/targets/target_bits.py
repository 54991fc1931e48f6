"""Equal bits of the filter on the host and on emulated boards, for robots, cores, compilers and optimisation levels."""

from __future__ import annotations

import zlib
from collections import Counter
from itertools import product
from typing import Any

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.kernel import kernel_hash
from dualbrain.safety.target.boards import BOARDS, TOOLCHAINS, find_board
from dualbrain.safety.target.build import KEY_BYTES, Firmware
from dualbrain.safety.target.emulated_board import EmulatedBoard
from dualbrain.safety.target.robot_tables import robot_tables_hash
from dualbrain.safety.target.session import TargetLostError, TargetSession
from dualbrain.safety.target.target_filter import TargetFilter
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.robots.targets.built_firmware import built_firmware
from experiments.robots.targets.recorded_steps import RecordedSteps, compare_steps, record_steps

ROBOTS, LEVELS = ("panda", "ur5e", "base"), ("-O2", "-Os")
STEPS, BLOCKS = 10_000, 34
"""Steps of one unit, and units of each robot: 3 x 34 x 10,000 steps, each on 12 builds."""
BUILDS = tuple(product(BOARDS, TOOLCHAINS, LEVELS))
RULE_OF_THREE = 3.0


class TargetBits:
    """Every step on the host and on a board; one bit that differs in control or result counts."""

    name = "target_bits"
    claim = (
        "In 1.02e6 steps of Panda, UR5e and mobile base, every result of the filter on emulated Cortex-M4F, M7 and M33 "
        "has the bits of the host's, with both compilers, at -O2 and at -Os."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """One block of one robot on all builds."""
        del options
        kinds = product(range(BLOCKS), ROBOTS)
        return [WorkUnit(f"{robot} {block}", {"robot": robot, "block": block}) for block, robot in kinds]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Record the steps on the host, then repeat them on each build."""
        robot = parameters["robot"]
        recorded = record_steps(robot, [parameters["block"], zlib.crc32(robot.encode())], STEPS)
        builds = {" ".join(build): _run_on_board(robot, build, recorded) for build in BUILDS}
        return {**parameters, "statuses": dict(recorded.statuses), "builds": builds, "kernel": kernel_hash()}

    def summarize_row(self, row: Row) -> str:
        """The steps, and those with different bits."""
        steps, differences, lost = (_total([row], name) for name in ("steps", "differences", "lost"))
        return f"{differences} of {steps} steps on boards differ, {lost} builds lost"

    def report(self, rows: list[Row]) -> list[str]:
        """One line for each build, one column for each robot; then the results by status."""
        heads = ("core", "compiler", *(f"steps of {robot}" for robot in ROBOTS), "with a control", "different bits")
        steps, differences = _total(rows, "steps"), _total(rows, "differences")
        limit = f"at most {RULE_OF_THREE / steps:.1e} (95 %, one-sided, 3/n)" if not differences else "see the table"
        lost, kernels = _total(rows, "lost"), ", ".join(sorted({row["kernel"] for row in rows}))
        return [
            f"{STEPS * len(rows):,} steps ran on the host and on each of {len(BUILDS)} builds. Of these "
            f"{steps:,} steps on boards, {differences} have other bits than the host's: {limit}. "
            f"{lost} builds stopped answering. Kernel {kernels}.",
            "",
            *markdown_table(heads, [_table_row(build, rows) for build in BUILDS]),
            "At a standstill the control is zero; all other values of a result are compared there too.",
            "",
            "Share of the results by status:",
            "",
            *_status_table(rows),
        ]


def _total(rows: list[Row], name: str, *, build: str = "", robot: str = "") -> int:
    """Sum of one count over the builds of the rows, of one build or robot if named."""
    return sum(
        counts[name]
        for row in rows
        for key, counts in row["builds"].items()
        if (not build or key == build) and (not robot or row["robot"] == robot)
    )


def _table_row(build: tuple[str, str, str], rows: list[Row]) -> tuple[str, ...]:
    board, toolchain, level = build
    key = " ".join(build)
    by_robot = (f"{_total(rows, 'steps', build=key, robot=robot):,}" for robot in ROBOTS)
    controls, differences = (_total(rows, name, build=key) for name in ("controls", "differences"))
    return (f"{BOARDS[board].core} ({board})", f"{toolchain} {level}", *by_robot, f"{controls:,}", str(differences))


def _run_on_board(robot: str, build: tuple[str, str, str], recorded: RecordedSteps) -> dict[str, int]:
    """Counts of the recorded steps on one build."""
    model, board = load_robot(robot), find_board(build[0])
    config = operating_config(model)
    wanted = Firmware(board=board, key=bytes(KEY_BYTES), toolchain=build[1], optimisation=build[2])
    firmware, elf = built_firmware(robot, wanted)
    lost = controls = 0
    with EmulatedBoard(board, elf) as emulated:
        session = TargetSession(emulated.link, firmware.key, robot_tables_hash(model, config))
        kernel = TargetFilter(model, config, session).target
        try:
            controls = compare_steps(recorded, session, kernel)
        except TargetLostError:
            lost = 1
    return {"steps": kernel.steps, "controls": controls, "differences": kernel.differences, "lost": lost}


def _status_table(rows: list[Row]) -> list[str]:
    """Share of the statuses: the steps exercise more than the unmodified control."""
    counts = {robot: Counter[str]() for robot in ROBOTS}
    for row in rows:
        counts[row["robot"]].update(row["statuses"])
    names = sorted({name for one in counts.values() for name in one})
    body = [
        (robot, *(f"{100 * one[name] / one.total():.2f} %" for name in names)) for robot, one in counts.items() if one
    ]
    return markdown_table(("robot", *names), body)
