"""Foreign robot descriptions, imported and driven by an adversary."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from dualbrain.robots.importer.build_arm import ImportOptions, ImportResult, build_arm
from dualbrain.robots.importer.build_mobile_base import build_base
from dualbrain.robots.importer.kinematic_tree import KinematicTree
from dualbrain.robots.importer.urdf import read_urdf
from dualbrain.safety.cbf.filter import FilterStatus
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.robots.zoo.zoo_adversary import run_attack
from experiments.robots.zoo.zoo_oracle import compare_kinematics
from experiments.robots.zoo.zoo_robots import EMPTY_FILES, EXCLUDED, ROBOTS, ZooRobot, robots_folder, stated_limits

N_SCENES, STEPS_PER_SCENE, N_STATES = 10, 10_000, 100
KINEMATICS_TOLERANCE = 1e-9
"""Largest accepted difference from Pinocchio in any entry of a pose or Jacobian."""
ROBOTS_BY_NAME = {robot.name: robot for robot in ROBOTS}


def import_robot(robot: ZooRobot, *, quick: bool) -> tuple[KinematicTree, ImportResult]:
    """The kinematic tree and the robot model of one robot of the zoo."""
    tree = read_urdf(robots_folder() / robot.file)
    options = ImportOptions(name=robot.name, base=robot.base, tip=robot.tip, tool="", lock=robot.lock, quick=quick)
    limits = stated_limits(robot)
    return tree, build_base(tree, limits, options, robot.wheels) if robot.mobile else build_arm(tree, limits, options)


class RobotZoo:
    """Any robot: imported by one command, equal to Pinocchio, safe against an adversary."""

    name = "robot_zoo"
    claim = (
        "Every serial arm and mobile base of example-robot-data can be imported: all surfaces covered, kinematics and "
        "Jacobians equal to Pinocchio's at 100 random states, and no true h below zero in 1e5 adversarial steps each."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """One unit per robot."""
        del options
        return [WorkUnit(robot.name, {"robot": robot.name}) for robot in ROBOTS]

    def run(
        self, parameters: dict[str, Any], scenes: int = N_SCENES, steps: int = STEPS_PER_SCENE, states: int = N_STATES
    ) -> Row:
        """Import the robot, compare its kinematics, and run the adversary."""
        robot, start = ROBOTS_BY_NAME[parameters["robot"]], time.monotonic()
        tree, imported = import_robot(robot, quick=True)
        seconds = time.monotonic() - start
        pose, jacobian = compare_kinematics(robot, tree, imported.robot_model, states, np.random.default_rng(0))
        attacks = [run_attack(imported.robot_model, seed, steps) for seed in range(scenes)]
        robot_model, links = imported.robot_model, imported.report.links
        weights = [link.spheres for link in links]
        return {
            **parameters,
            "file": Path(robot.file).name,
            "tip": robot_model.tool.link,
            "n": robot_model.n,
            "spheres": len(robot_model.spheres),
            "kept": len(robot_model.self_pairs.kept),
            "coverage": imported.report.coverage,
            "mean": float(np.average([link.mean for link in links], weights=weights)),
            "worst": max(link.worst for link in links if link.group != "base" or len(links) == 1),
            "always": [f"{a}–{b}" for a, b, why in robot_model.self_pairs.allowed if "overlap in all" in why],
            "made_s": seconds,
            "pose": pose,
            "jacobian": jacobian,
            "steps": scenes * steps,
            "status": np.sum([one.status for one in attacks], axis=0).tolist(),
            "below": sum(one.n_below_zero for one in attacks),
            "h_things": min(one.h_obstacles for one in attacks),
            "h_self": min(one.h_self for one in attacks),
            "h_joint": min(one.h_joint for one in attacks),
        }

    def summarize_row(self, row: Row) -> str:
        """Steps with h < 0, and the difference from Pinocchio."""
        return f"{row['below']} of {row['steps']} below zero, pose {row['pose']:.1e}, Jacobian {row['jacobian']:.1e}"

    def report(self, rows: list[Row]) -> list[str]:
        """Robots, attacks, and the robots left out with the reason."""
        failed = [row["robot"] for row in rows if failure_reasons(row)]
        return [
            f"{len(rows)} robots of {len(ROBOTS)}; all claims hold for {len(rows) - len(failed)}. "
            f"Steps: {sum(row['steps'] for row in rows):.3g}, with h < 0: {sum(row['below'] for row in rows)}.",
            "",
            *markdown_table(TABLE_HEAD, map(table_row, rows)),
            "Left out: "
            + "; ".join(f"{why}: {', '.join(names)}" for why, names in EXCLUDED.items())
            + ". "
            + "; ".join(f"{file}: {why}" for file, why in EMPTY_FILES.items())
            + ".",
        ]


TABLE_HEAD = (
    "robot",
    "file",
    "n",
    "spheres",
    "covered",
    "excess of the spheres: mean, worst [mm]",
    "self-collision pairs",
    "import time [s]",
    "Δ pose, Jacobian to Pinocchio",
    "h < 0",
    "smallest h: obstacles, own links [mm]; joints [mrad]",
    "safe / modified / relaxed / stopped / fault [%]",
    "failure",
)


def table_row(row: Row) -> tuple[object, ...]:
    """One line of the table."""
    shares = " / ".join(f"{100 * count / row['steps']:.1f}" for count in row["status"])
    own, joint = (f"{row[key] * 1e3:.3f}" if row[key] < 1e3 else "none" for key in ("h_self", "h_joint"))
    return (
        row["robot"],
        row["file"],
        row["n"],
        row["spheres"],
        f"{row['coverage']:.2%}",
        f"{row['mean'] * 1e3:.0f}, {row['worst'] * 1e3:.0f}",
        row["kept"],
        f"{row['made_s']:.0f}",
        f"{row['pose']:.0e}, {row['jacobian']:.0e}",
        row["below"],
        f"{row['h_things'] * 1e3:.3f}, {own}; {joint}",
        shares,
        failure_reasons(row) or "",
    )


def failure_reasons(row: Row) -> str:
    """The parts of the claim that do not hold for a robot, as text."""
    reasons = [
        (row["coverage"] < 1.0, f"{row['coverage']:.3%} covered"),
        (max(row["pose"], row["jacobian"]) > KINEMATICS_TOLERANCE, "differs from Pinocchio"),
        (row["below"] > 0, f"h below zero on {row['below']} steps"),
        (row["status"][FilterStatus.FAULT] > 0, f"{row['status'][FilterStatus.FAULT]} faults"),
    ]
    return ", ".join(why for bad, why in reasons if bad)
