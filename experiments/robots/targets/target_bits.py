"""Equal bits of the filter on the host and on emulated boards, for robots, cores, compilers and optimisation levels."""

from __future__ import annotations

import tempfile
import zlib
from collections import Counter
from functools import cache
from itertools import product
from pathlib import Path
from secrets import token_bytes
from typing import Any

import numpy as np

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.kernel import kernel_hash
from dualbrain.safety.target.boards import BOARDS, TOOLCHAINS, find_board
from dualbrain.safety.target.build import KEY_BYTES, Firmware, build_firmware
from dualbrain.safety.target.emulated_board import EmulatedBoard
from dualbrain.safety.target.robot_tables import robot_tables_hash
from dualbrain.safety.target.session import TargetSession
from dualbrain.safety.target.target_filter import TargetFilter
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.robots.targets.target_steps import RandomMotion

ROBOTS, LEVELS = ("panda", "ur5e", "base"), ("-O2", "-Os")
STEPS, BLOCKS = 10_000, 34
"""Steps of one unit, and units of each robot and build: 3 x 34 x 10,000 steps on each of 12 builds."""
RULE_OF_THREE = 3.0


class TargetBits:
    """Every step on the host and on a board; one bit that differs in control or result counts."""

    name = "target_bits"
    claim = (
        "In 1.02e6 steps of Panda, UR5e and mobile base, every result of the filter on emulated Cortex-M4F, M7 and M33 "
        "has the bits of the host's, with both compilers, at -O2 and at -Os."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Block by block over all builds, so that a part of the units covers each of them."""
        del options
        kinds = product(range(BLOCKS), ROBOTS, BOARDS, TOOLCHAINS, LEVELS)
        names = ("block", "robot", "board", "toolchain", "level")
        return [WorkUnit(" ".join(map(str, kind)), dict(zip(names, kind, strict=True))) for kind in kinds]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One block of one robot on one build."""
        robot, board = parameters["robot"], find_board(parameters["board"])
        model, (elf, key) = load_robot(robot), _build(**{k: v for k, v in parameters.items() if k != "block"})
        config = operating_config(model)
        seed = [parameters["block"], zlib.crc32(robot.encode())]
        with EmulatedBoard(board, elf) as emulated:
            session = TargetSession(emulated.link, key, robot_tables_hash(model, config))
            safety = TargetFilter(model, config, session)
            statuses = RandomMotion(model, np.random.default_rng(seed)).run(safety, STEPS)
        target = safety.target
        counts = {"steps": target.steps, "differences": target.differences, "lost": target.lost}
        return {**parameters, **counts, "statuses": dict(statuses), "kernel": kernel_hash()}

    def summarize_row(self, row: Row) -> str:
        """The steps, and those with different bits."""
        return f"{row['differences']} of {row['steps']} steps differ{'; lost: ' + row['lost'] if row['lost'] else ''}"

    def report(self, rows: list[Row]) -> list[str]:
        """One line for each build, one column for each robot; then the results by status."""
        heads = ("core", "compiler", *(f"steps of {robot}" for robot in ROBOTS), "different bits", "at most (95 %)")
        body = [_table_row(kind, _of(rows, *kind)) for kind in product(BOARDS, TOOLCHAINS, LEVELS)]
        sequences = {(row["robot"], row["block"]) for row in rows}
        complete = [one for one in sequences if sum((row["robot"], row["block"]) == one for row in rows) == len(body)]
        lost = [f"Lost: {row['key']}: {row['lost']}" for row in rows if row["lost"]]
        return [
            f"{STEPS * len(complete):,} steps ran on the host and on all {len(body)} builds; on a board in total "
            f"{sum(row['steps'] for row in rows):,}, of which {sum(row['differences'] for row in rows)} differ. "
            f"Kernel {', '.join(sorted({row['kernel'] for row in rows}))}.",
            "",
            *markdown_table(heads, [row for row in body if row]),
            "The last column is the one-sided 95 % limit of the share of different steps, 3/n for none in n steps.",
            "",
            *_status_table(rows),
            *lost,
        ]


def _of(rows: list[Row], board: str, toolchain: str, level: str) -> list[Row]:
    return [row for row in rows if (row["board"], row["toolchain"], row["level"]) == (board, toolchain, level)]


def _table_row(kind: tuple[str, str, str], rows: list[Row]) -> tuple[str, ...]:
    if not rows:
        return ()
    board, toolchain, level = kind
    steps, differences = (sum(row[name] for row in rows) for name in ("steps", "differences"))
    by_robot = (f"{sum(row['steps'] for row in rows if row['robot'] == robot):,}" for robot in ROBOTS)
    limit = f"{RULE_OF_THREE / steps:.1e}" if not differences else "-"
    return (f"{BOARDS[board].core} ({board})", f"{toolchain} {level}", *by_robot, str(differences), limit)


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


@cache
def _build(robot: str, board: str, toolchain: str, level: str) -> tuple[Path, bytes]:
    """The firmware of one robot, built once in a worker process, and its key."""
    model, key = load_robot(robot), token_bytes(KEY_BYTES)
    firmware = Firmware(board=find_board(board), key=key, toolchain=toolchain, optimisation=level)
    _FOLDERS.append(folder := tempfile.TemporaryDirectory(prefix="dualbrain-firmware-"))
    return build_firmware(firmware, model, operating_config(model), Path(folder.name)), key


_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []
"""Folders of the firmware, removed when the process ends."""
