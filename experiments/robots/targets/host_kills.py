"""Kills of the host at random moments while an arm moves with firmware on an emulated board."""

from __future__ import annotations

from typing import Any

import numpy as np

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.target.boards import BOARDS, find_board
from dualbrain.safety.target.build import KEY_BYTES, Firmware
from dualbrain.safety.target.emulated_board import EmulatedBoard
from dualbrain.safety.target.link import MailboxLink
from dualbrain.safety.target.robot_tables import robot_tables_hash
from dualbrain.safety.target.session import TargetSession
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.robots.targets.built_firmware import built_firmware
from experiments.robots.targets.killed_host import DECLARED_S, WAIT_S, kill_host
from experiments.safety.random_scenes import random_obstacles, random_posture
from experiments.safety.reference_judge import build_judge, true_h

ROBOT, KILLS, UNITS, N_OBSTACLES = "panda", 20, 51, 8
RUN_S = (0.05, 1.0)
"""Range of the time of motion before the kill [s]."""
LAST_CYCLE_RISE = 0.02
"""Most change of a joint speed in one period [rad/s]."""
ROUNDING_SPEED = 1e-6
"""Difference of two speeds that counts as none [rad/s]."""


class HostKills:
    """After each kill the arm brakes, its drive is switched off, and no true distance falls below zero."""

    name = "host_kills"
    claim = (
        "In 1,020 kills of the host at random moments, each board brakes the moving arm and switches its drive off. "
        "The speed does not rise by more than one cycle changes it, and no true h is below zero until the end."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Units on the three boards in turns."""
        del options
        boards = list(BOARDS)
        return [WorkUnit(str(k), {"unit": k, "board": boards[k % len(boards)]}) for k in range(UNITS)]

    def run(self, parameters: dict[str, Any]) -> Row:
        """`KILLS` kills in random scenes."""
        found = [run_kill(parameters["board"], KILLS * parameters["unit"] + k) for k in range(KILLS)]
        return {**parameters, **{name: [one[name] for one in found] for name in found[0]}}

    def summarize_row(self, row: Row) -> str:
        """The latest drive, and the smallest distance."""
        return f"drive off after at most {max(row['off_s']):.3f} s, h >= {min(row['h']) * 1e3:.1f} mm"

    def report(self, rows: list[Row]) -> list[str]:
        """One line for each board."""
        heads = (
            "core",
            "kills",
            "drive on, arm in motion",
            "drive off by the clock of the host [s]: median, 99 %, latest",
        )
        heads += (
            "drive stayed on",
            "speed rose: kills, most [rad/s]",
            "h < 0",
            "smallest h of an obstacle but the table [mm]",
        )
        body = [_table_row(board, [row for row in rows if row["board"] == board]) for board in BOARDS]
        return [
            *markdown_table(heads, [row for row in body if row]),
            f"By its own clock the target switches the drive off {DECLARED_S * 1e3:.0f} ms after the last cycle. The "
            "times above are of the kills with the drive on; they also contain the delays of the emulator and of the "
            "observer. A host that is late by 150 ms before its kill has its drive switched off, too. A rise of "
            f"at most {LAST_CYCLE_RISE:g} rad/s is that of one cycle: a host that is killed after it has read a reply "
            "and before it has recorded it leaves a control that the observer does not know.",
        ]


def _table_row(board: str, rows: list[Row]) -> tuple[str, ...]:
    if not rows:
        return ()
    names = ("speed", "was_on", "off_s", "stayed_on", "rise", "h", "h_scene")
    columns = {name: np.concatenate([row[name] for row in rows]) for name in names}
    moving = columns["was_on"] & (columns["speed"] > 0.0)
    off = columns["off_s"][moving & ~columns["stayed_on"]]
    p50, p99 = np.percentile(off, (50, 99))
    return (
        f"{BOARDS[board].core} ({board})",
        str(len(columns["h"])),
        str(int(moving.sum())),
        f"{p50:.3f}, {p99:.3f}, {off.max():.3f}",
        str(int(columns["stayed_on"].sum())),
        f"{int((columns['rise'] > ROUNDING_SPEED).sum())}, {columns['rise'].max():.4f}",
        str(int((columns["h"] < 0.0).sum())),
        f"{columns['h_scene'].min() * 1e3:.2f}",
    )


def run_kill(board_name: str, seed: int) -> Row:
    """One kill: speed at the kill [rad/s], time until the drive is off [s], rise of the speed, smallest true h [m]."""
    model, rng = load_robot(ROBOT), np.random.default_rng(seed)
    judge = build_judge(model, opening=0.02)
    q = random_posture(model, judge, rng)
    scene = random_obstacles(judge, q, rng, N_OBSTACLES)
    board = find_board(board_name)
    firmware, elf = built_firmware(ROBOT, Firmware(board=board, key=bytes(KEY_BYTES), lockstep=False))
    with EmulatedBoard(board, elf) as emulated:
        link = emulated.link
        assert isinstance(link, MailboxLink)
        session = TargetSession(link, firmware.key, robot_tables_hash(model, operating_config(model)))
        stop = kill_host(link, session, model, q, scene, seed=seed, after_s=float(rng.uniform(*RUN_S)))
    speeds = np.abs(stop.controls).max(axis=1)
    h = true_h(judge, stop.path, scene)[:, [0, 2, 3]]
    return {
        "speed": float(speeds[0]),
        "was_on": stop.was_on,
        "cycles": stop.cycles,
        "off_s": round(min(float(stop.off_s), WAIT_S), 4),
        "stayed_on": bool(np.isinf(stop.off_s)),
        "rise": float(np.max(np.diff(speeds), initial=0.0)),
        "last_speed": float(speeds[-1]),
        "h": float(h.min()),
        "h_scene": float(true_h(judge, stop.path, scene[1:])[:, 0].min()),
    }
