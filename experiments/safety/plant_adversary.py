"""At least 1e7 adversarial steps on the MuJoCo plant, with h on the plant's own shapes, for both kinds of drive."""

from __future__ import annotations

from functools import cache
from time import process_time
from typing import Any

import numpy as np

from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.compiled._kernel import ReferenceDistance
from dualbrain.safety.cbf.filter import BarrierRow, SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.simulation.plant.joint_drive import DriveKind
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.stepped_plant import SteppedPlant
from dualbrain.simulation.scenes.scene_spec import ObjectSpec, SceneSpec
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.safety import random_scenes
from experiments.safety.plant_judge import PlantJudge
from experiments.safety.reference_judge import build_judge, true_h

EPISODES_PER_UNIT, STEPS_PER_EPISODE = 10, 10_000
UNITS_PER_DRIVE = 51
"""Number of units for each kind of drive, 5.1e6 steps."""
SUMMED_FIELDS = ("steps", "below", "below_spheres", "below_joints", "looks")
MINIMUM_FIELDS = ("h_scene", "h_own", "h_spheres", "h_joint")

IDENTIFIED_DRIVES: tuple[DriveKind, ...] = ("velocity", "computed_torque")
"""The drives whose tracking error is in the robot model."""


class PlantAdversary:
    """The tracking model holds on the plant: no shape of the arm touches an obstacle."""

    name = "plant_adversary"
    claim = (
        "In at least 1e7 adversarial steps on the MuJoCo plant, half with velocity actuators and half with computed "
        "torque, the rows at the measured state keep every true h, on the plant's own shapes, at or above zero."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Units of both drives in turn."""
        del options
        return [
            WorkUnit(f"{kind} {block}", {"drive": kind, "block": block})
            for block in range(UNITS_PER_DRIVE)
            for kind in IDENTIFIED_DRIVES
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """`EPISODES_PER_UNIT` random scenes of `STEPS_PER_EPISODE` periods each."""
        first = parameters["block"] * EPISODES_PER_UNIT
        return {
            **parameters,
            **aggregate([run_episode(parameters["drive"], seed) for seed in range(first, first + EPISODES_PER_UNIT)]),
        }

    def summarize_row(self, row: Row) -> str:
        """The smallest distance and the duration of a step."""
        least = min(row["h_scene"], row["h_own"])
        return f"h >= {least * 1e3:.2f} mm on shapes, below zero on {row['below']}; {row['us']:.0f} µs per step"

    def report(self, rows: list[Row]) -> list[str]:
        """One line per drive."""
        totals = {
            kind: aggregate(group)
            for kind in IDENTIFIED_DRIVES
            if (group := [row for row in rows if row["drive"] == kind])
        }
        steps = sum(t["steps"] for t in totals.values())
        below = sum(t["below"] for t in totals.values())
        others = sum(t["below_spheres"] + t["below_joints"] for t in totals.values())
        first = (
            f"Steps: **{steps:.3g}**; true h below zero on the plant's own shapes on **{below}**, at a joint limit "
            f"or on the filter's spheres at the true posture on **{others}**."
        )
        return [first, "", *markdown_table(_TABLE_HEAD, (_table_row(kind, t) for kind, t in totals.items()))]


def run_episode(kind: DriveKind, seed: int, steps: int = STEPS_PER_EPISODE) -> Row:
    """One random scene, start posture and adversary, judged at every state of the plant."""
    robot_model, judge = load_panda(kind)
    rng = np.random.default_rng([seed, IDENTIFIED_DRIVES.index(kind), 3])
    start = random_scenes.random_posture(robot_model, judge, rng)
    truth = random_scenes.random_obstacles(judge, start, rng, int(rng.integers(4, 12)))
    plant = Plant(
        SceneSpec(robot="panda", family="hazards", seed=seed, objects=tuple(map(_scene_object, truth[1:])), places=()),
        robot_model,
        drive=kind,
    )
    plant.set_configuration(start)
    safety = SafetyFilter(robot_model)
    safety.observe(truth, 0.0)
    start_time = process_time()
    q, status, shapes = run_closed_loop(SteppedPlant(plant, contacts=False), safety, PlantJudge(plant), rng, steps)
    spheres = true_h(judge, q, truth)
    return {
        "steps": steps,
        "status": np.bincount(status, minlength=5).tolist(),
        "below": int(shapes.n_below_zero),
        "below_spheres": int(np.sum(np.minimum(spheres[:, 0], spheres[:, 2]) < 0.0)),
        "below_joints": int(np.sum(spheres[:, 3] < 0.0)),
        "looks": shapes.n_measurements,
        "h_scene": shapes.min_scene_distance,
        "h_own": shapes.min_self_distance,
        "h_spheres": float(spheres[:, [0, 2]].min()),
        "h_joint": float(spheres[:, 3].min()),
        "us": (process_time() - start_time) / steps * 1e6,
    }


def run_closed_loop(
    robot: SteppedPlant, safety: SafetyFilter, shapes: PlantJudge, rng: np.random.Generator, steps: int
) -> tuple[np.ndarray, np.ndarray, PlantJudge]:
    """The loop: measure, judge, filter at the measured state, apply.

    Returns the true postures (steps, n) [rad], the filter statuses (steps,) and `shapes`.
    """
    n = safety.robot_model.n
    v_max = np.array([joint.velocity.value for joint in safety.robot_model.joints])
    opening = float(safety.robot_model.gripper.opening.value)
    path, status, u_nom = np.empty((steps, n)), np.empty(steps, np.int64), np.zeros(n)
    until = 0
    for t in range(steps):
        robot.measure()
        path[t] = robot.q
        shapes.update()
        if t >= until:
            u_nom, until = _worst_nominal(safety.rows(), v_max, rng), t + int(rng.choice((150, 400, 1000)))
        result = safety(path[t], robot.v, u_nom, opening=opening)
        status[t] = result.status
        robot.apply(result.u)
    return path, status, shapes


def _worst_nominal(rows: tuple[BarrierRow, ...], v_max: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Nominal control at full speed against the nearest row, sometimes against any row, sometimes bang-bang."""
    signs = np.where(rng.random(len(v_max)) < 0.5, -1.0, 1.0)
    if not rows or rng.random() < 0.1:
        return signs * v_max
    row = min(rows, key=lambda r: r.h) if rng.random() < 0.7 else rows[int(rng.integers(len(rows)))]
    return np.where(row.a > 0.0, -1.0, 1.0) * v_max


@cache
def load_panda(kind: str) -> tuple[RobotModel, ReferenceDistance]:
    """The Panda with the identified model of this drive, and the reference distances of its spheres, fingers open."""
    robot_model = load_robot("panda").with_drive(kind)
    return robot_model, build_judge(robot_model, float(robot_model.gripper.opening.value))


def aggregate(rows: list[Row]) -> Row:
    """Sums and minima; the mean of the step durations."""
    whole: Row = {key: sum(row[key] for row in rows) for key in SUMMED_FIELDS}
    whole |= {key: min(row[key] for row in rows) for key in MINIMUM_FIELDS}
    status = np.sum([row["status"] for row in rows], axis=0).tolist()
    return whole | {"status": status, "us": float(np.mean([row["us"] for row in rows]))}


_TABLE_HEAD = (
    "drive",
    "steps",
    "h < 0 on shapes",
    "smallest h: scene / own links",
    "h < 0 on spheres",
    "smallest h on spheres",
    "joint limit passed",
    "smallest distance to a joint limit",
    "safe / modified / relaxed / stopped / fault",
    "µs per step",
)


def _table_row(kind: str, t: Row) -> tuple[object, ...]:
    model = load_robot("panda").with_drive(kind)
    lag, error = model.tracking.lag, max(model.tracking.position_errors(model.n))
    shares = " / ".join(f"{count / t['steps']:.2%}" for count in t["status"])
    return (
        f"{kind} (lag {lag * 1e3:g} ms, e {error * 1e3:g} mrad)",
        f"{t['steps']:.3g}",
        t["below"],
        f"{t['h_scene'] * 1e3:.2f} / {t['h_own'] * 1e3:.2f} mm",
        t["below_spheres"],
        f"{t['h_spheres'] * 1e3:.3f} mm",
        t["below_joints"],
        f"{t['h_joint'] * 1e3:.3f} mrad",
        shares,
        f"{t['us']:.0f}",
    )


def _scene_object(obstacle: Obstacle) -> ObjectSpec:
    return ObjectSpec(
        name=obstacle.name,
        role="obstacle",
        shape=obstacle.shape,
        position=obstacle.pose.position,
        mass=1.0,
        colour="grey",
        category="obstacle",
        quaternion=obstacle.pose.quaternion,
        fixed=True,
    )
