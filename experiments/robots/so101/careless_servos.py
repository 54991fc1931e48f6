"""A careless policy on a simulated SO-101 with stock servos: unguarded, with LeRobot's own clamp, and guarded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np

from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose
from dualbrain.robots.collision_model.self_collision import chain_frames, sphere_centres
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.result import FilterStatus
from dualbrain.safety.integration.servo_bus.guarded_servos import GuardedServos
from dualbrain.safety.integration.servo_bus.servo_map import ServoMap
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table
from experiments.robots.so101.servo_arm import SERVOS, ServoArm

SEEDS = 40
SECONDS, POLICY_RATE, BUS_PERIOD = 30.0, 30.0, 0.005
TARGET_HOLD = 20
"""Number of actions for which the policy keeps a random target."""
RANGES = np.radians([[-80, 80], [-60, 60], [-60, 60], [-60, 60], [-90, 90], [-10, 100]])
"""Range of the targets of each servo [rad]."""
CLAMP = np.radians(5.0)
"""LeRobot's `max_relative_target` in the runs with its clamp [rad]."""
MODES = ("raw", "clamp", "guarded", "guarded_without_error")
"""Unguarded, with LeRobot's clamp, guarded, and guarded by a filter that knows neither lag nor tracking error."""
CONTACT_CHECK = 4
"""Every n-th bus period the distances are measured."""
KEYS = tuple(f"{name}.pos" for name in SERVOS)


@dataclass(slots=True, kw_only=True)
class Episode:
    """What one episode has touched so far, and how far the arm has moved."""

    touched: bool = False
    force: float = 0.0
    clearance: float = 1.0
    travel: float = 0.0
    interventions: list[bool] = field(default_factory=list[bool])
    faults: int = 0
    steps: int = 0
    path: list[np.ndarray] = field(default_factory=list[np.ndarray])


class CarelessServos:
    """With the identified tracking error, a guarded arm of position servos touches nothing."""

    name = "careless_servos"
    claim = (
        "With stock servo gains and without a margin set by hand, a guarded SO-101 under a careless policy touches "
        "neither table nor crate, in scenes where the unguarded arm touches them in more than half of the episodes."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """One scene per unit, in all modes."""
        del options
        return [WorkUnit(f"seed {seed}", {"seed": seed}) for seed in range(SEEDS)]

    def run(self, parameters: dict[str, Any]) -> Row:
        """The same policy in the same scene in every mode."""
        return {**parameters, **{mode: run_episode(mode, parameters["seed"]) for mode in MODES}}

    def summarize_row(self, row: Row) -> str:
        """Which modes touched something."""
        return ", ".join(f"{mode} {'touched' if row[mode]['touched'] else 'clear'}" for mode in MODES)

    def report(self, rows: list[Row]) -> list[str]:
        """One line per mode."""
        return markdown_table(TABLE_HEAD, [_table_row(mode, [row[mode] for row in rows]) for mode in MODES])


def scene(seed: int) -> tuple[Obstacle, ...]:
    """The table, and a crate at a random place within reach that leaves the start posture free."""
    rng = np.random.default_rng([seed, 7])
    angle, reach = rng.uniform(0.4, 1.2) * rng.choice([-1.0, 1.0]), rng.uniform(0.22, 0.32)
    half = (rng.uniform(0.03, 0.06), rng.uniform(0.03, 0.06), rng.uniform(0.04, 0.09))
    position = (float(reach * np.cos(angle)), float(reach * np.sin(angle)), half[2])
    return (Obstacle("table", HalfSpace()), Obstacle("crate", Box(half), Pose(position)))


def run_episode(mode: str, seed: int, seconds: float = SECONDS) -> Row:
    """One episode of the careless policy; distances and contacts are those of the simulated arm."""
    robot_model, obstacles = load_robot("so101"), scene(seed)
    arm = ServoArm(obstacles=obstacles[1:], start=(*robot_model.home, 0.5), period=BUS_PERIOD)
    policy, command, episode = careless_policy(seed), make_command(mode, obstacles), Episode()
    next_action, last, target = 0, arm.q, np.zeros(len(SERVOS))
    for period in range(round(seconds / BUS_PERIOD)):
        arm.measure()
        if period * BUS_PERIOD >= next_action / POLICY_RATE:
            target, next_action = policy(next_action), next_action + 1
            command.begin(target, arm)
        command.step(arm, episode)
        arm.advance()
        episode.travel += float(np.abs(arm.q - last).sum())
        last = arm.q
        judge(arm, episode, period)
    heights = sphere_heights(np.array(episode.path), obstacles)
    return {
        "h_spheres": float(heights.min()),
        "below": int(np.sum(heights < 0.0)),
        "touched": episode.touched,
        "force": episode.force,
        "clearance": episode.clearance,
        "travel": float(np.degrees(episode.travel)),
        "interventions": float(np.mean(episode.interventions)) if episode.interventions else 0.0,
        "faults": episode.faults,
        "steps": episode.steps,
    }


def judge(arm: ServoArm, episode: Episode, period: int) -> None:
    """Note the posture, contacts of the moving parts with table and crate, and their least distance."""
    episode.path.append(arm.posture())
    count, force = arm.scene_contacts()
    episode.touched |= count > 0
    episode.force = max(episode.force, force)
    if period % CONTACT_CHECK == 0:
        episode.clearance = min(episode.clearance, arm.clearance())
        episode.touched |= episode.clearance < 0.0  # the pads of the jaws make no contacts


def sphere_heights(path: np.ndarray, obstacles: tuple[Obstacle, ...]) -> np.ndarray:
    """The least distance (m,) [m] of the filter's spheres from table and crate at the postures `path` (m, 5) [rad].

    The spheres of base and shoulder are left out: no joint moves them toward the table.
    """
    robot_model = load_robot("so101")
    turns, origins = chain_frames(robot_model.joints, path)
    crate = obstacles[1]
    assert isinstance(crate.shape, Box)
    least = np.full(len(path), np.inf)
    for link in robot_model.links[2:]:
        spheres = [sphere for sphere in robot_model.spheres if sphere.link == link.name]
        centres = sphere_centres(link, np.array([sphere.centre for sphere in spheres]), turns, origins, 0.0)
        radii = np.array([sphere.radius for sphere in spheres])
        outside = np.abs(centres - np.array(crate.pose.position)) - np.array(crate.shape.half_extents)
        to_crate = np.linalg.norm(np.maximum(outside, 0.0), axis=2) + np.minimum(outside.max(axis=2), 0.0)
        gaps = np.minimum(to_crate, centres[:, :, 2]) - radii
        least = np.minimum(least, gaps.min(axis=1))
    return least


def careless_policy(seed: int) -> Callable[[int], np.ndarray]:
    """Random targets (6,) [rad], each held for `TARGET_HOLD` actions."""
    rng = np.random.default_rng(seed)
    targets: list[np.ndarray] = []

    def act(action: int) -> np.ndarray:
        while len(targets) <= action // TARGET_HOLD:
            targets.append(rng.uniform(RANGES[:, 0], RANGES[:, 1]))
        return targets[action // TARGET_HOLD]

    return act


class _Direct:
    """The action reaches the servos as it is, or within `clamp` [rad] of the measured position, as LeRobot does it."""

    def __init__(self, clamp: float) -> None:
        self._clamp = clamp

    def begin(self, target: np.ndarray, arm: ServoArm) -> None:
        here = arm.positions()
        goal = here + np.clip(target - here, -self._clamp, self._clamp)
        arm.write(dict(zip(SERVOS, goal.tolist(), strict=True)))

    def step(self, arm: ServoArm, episode: Episode) -> None:
        del arm
        episode.steps += 1


class _Guarded:
    """The guard on the bus: it reads in every period and writes the newest safe target."""

    def __init__(self, obstacles: tuple[Obstacle, ...], *, with_error: bool) -> None:
        robot_model = load_robot("so101")
        config = operating_config(robot_model)
        if not with_error:
            config = msgspec.structs.replace(config, tracking_error=0.0, lag_compensation=False)
        safety = SafetyFilter(robot_model, config, obstacles=obstacles)
        self._servos = GuardedServos(safety, ServoMap.of(robot_model, KEYS), action_period=1.0 / POLICY_RATE)
        self._fresh = True

    def begin(self, target: np.ndarray, arm: ServoArm) -> None:
        if self._fresh:
            self._servos.reset(_in_degrees(arm.command))
            self._fresh = False
        self._servos.begin(_in_degrees(target), arm.now)

    def step(self, arm: ServoArm, episode: Episode) -> None:
        values = self._servos.step(_in_degrees(arm.positions()), arm.now)
        assert values is not None
        arm.write({key.removesuffix(".pos"): float(np.radians(value)) for key, value in values.items()})
        episode.steps += 1
        episode.faults += self._servos.report.status >= FilterStatus.STOPPED
        episode.interventions.append(self._servos.state.intervened)


def make_command(mode: str, obstacles: tuple[Obstacle, ...]) -> _Direct | _Guarded:
    """The way of an action to the servos in one of `MODES`."""
    if mode.startswith("guarded"):
        return _Guarded(obstacles, with_error=mode == "guarded")
    return _Direct(CLAMP if mode == "clamp" else float("inf"))


def _in_degrees(positions: np.ndarray) -> dict[str, float]:
    return {key: float(np.degrees(value)) for key, value in zip(KEYS, positions, strict=True)}


TABLE_HEAD = (
    "mode",
    "episodes that touch table or crate",
    "least distance [mm]",
    "least h on the filter's spheres [mm]; periods with h < 0",
    "greatest force [N]",
    "joint travel per episode [deg]",
    "periods in which the filter intervened",
    "periods with a stop or fault",
)


def _table_row(mode: str, rows: list[Row]) -> tuple[object, ...]:
    guarded = mode.startswith("guarded")
    return (
        mode.replace("_", " "),
        format_proportion(sum(row["touched"] for row in rows), len(rows)),
        f"{min(row['clearance'] for row in rows) * 1e3:.1f}",
        f"{min(row['h_spheres'] for row in rows) * 1e3:.1f}; {sum(row['below'] for row in rows)}",
        f"{max(row['force'] for row in rows):.1f}",
        f"{np.mean([row['travel'] for row in rows]):.0f}",
        f"{np.mean([row['interventions'] for row in rows]):.0%}" if guarded else "",
        f"{sum(row['faults'] for row in rows)} of {sum(row['steps'] for row in rows)}" if guarded else "",
    )
