"""Obstacles from depth images instead of known shapes: python -m experiments depth_obstacles."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from statistics import median
from typing import Any

from benchmarks.guards.episode import run_episode, run_guarded
from benchmarks.guards.guards.depth_guard import DepthGuard
from benchmarks.guards.policies import PERIOD
from benchmarks.guards.robot_interface import RobotInterface
from benchmarks.guards.scene import GuardScene, load_panda, make_scene
from benchmarks.guards.tables import GOAL_FREE_POLICY, is_safe_success
from dualbrain.simulation.plant.plant import Plant
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_share_by_scene, markdown_table

FIRST_SEED, N_SCENES = 1000, 60
POLICIES = ("careful", "careless", "random")
KNOWN, CAMERAS, UNKNOWN_OCCUPIED, UNGUARDED = "known shapes", "depth cameras", "depth cameras, unknown occupied", "none"


class DepthObstacles:
    """The same policies in the same scenes, with known shapes and with rendered depth images."""

    name = "depth_obstacles"
    intervals = "over scenes (bootstrap; Korn and Graubard for rare events), 95 %"
    claim = (
        "Behind the guard with obstacles from three depth cameras no link of the arm touches anything, for careful, "
        "careless and random policies; the cost is stated beside the guard that knows the true shapes."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Scene by scene, every policy; one unit runs the policy with all sources of obstacles."""
        del options
        return [
            WorkUnit(f"{seed} {policy}", {"seed": seed, "policy": policy})
            for seed in range(FIRST_SEED, FIRST_SEED + N_SCENES)
            for policy in POLICIES
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One policy in one scene."""
        scene, policy = _open_scene(parameters["seed"]), parameters["policy"]
        return {
            **parameters,
            "sources": {
                UNGUARDED: run_episode(scene, policy, "unguarded"),
                KNOWN: run_episode(scene, policy, "dualbrain"),
                CAMERAS: run_with_cameras(scene, policy, unknown_is_occupied=False),
                UNKNOWN_OCCUPIED: run_with_cameras(scene, policy, unknown_is_occupied=True),
            },
        }

    def summarize_row(self, row: Row) -> str:
        """Contacts and successes by source."""
        return ", ".join(
            f"{source}: {'contact' if found['contact'] else found['reached'] or 'no contact'}"
            for source, found in row["sources"].items()
        )

    def report(self, rows: list[Row]) -> list[str]:
        """Contacts and successes by policy, and the cost of an image."""
        lines = list[str]()
        for policy in POLICIES:
            some = [row for row in rows if row["policy"] == policy]
            lines += _policy_section(policy, some) if some else []
        return lines + _cost_section(rows)


def run_with_cameras(
    scene: GuardScene, policy: str, *, unknown_is_occupied: bool, duration: float | None = None
) -> dict[str, Any]:
    """One episode with obstacles from depth images, with medians over its images."""
    made: list[DepthGuard] = []
    found = run_guarded(scene, policy, _guard_maker(scene, made, unknown_is_occupied), duration)
    reports = made[0].reports
    return found | {
        "images": len(reports),
        "boxes": median(len(one.shapes) for one in reports),
        "voxels": median(one.n_voxels for one in reports),
        "lost": round(max(one.lost for one in reports), 4),
        "image_ms": round(1e3 * median(one.seconds for one in reports), 1),
    }


def _guard_maker(
    scene: GuardScene, made: list[DepthGuard], unknown_is_occupied: bool
) -> Callable[[Plant, RobotInterface], DepthGuard]:
    def make(plant: Plant, interface: RobotInterface) -> DepthGuard:
        guard = DepthGuard(
            load_panda()[0],
            scene.obstacles[0],
            interface,
            PERIOD,
            plant,
            seed=scene.seed,
            unknown_is_occupied=unknown_is_occupied,
        )
        made.append(guard)
        return guard

    return make


def _policy_section(policy: str, rows: list[Row]) -> list[str]:
    head = ["obstacles", "episodes", "with contact", "least distance from an obstacle [mm]"]
    head += ["reached the goal without contact", "action of 20 ms, median [ms]"]
    cells = [
        (
            source,
            len(rows),
            format_share_by_scene([(row["seed"], row["sources"][source]["contact"]) for row in rows]),
            f"{1e3 * min(row['sources'][source]['min_scene_distance'] for row in rows):.1f}",
            "–"
            if policy == GOAL_FREE_POLICY
            else format_share_by_scene([(row["seed"], is_safe_success(row["sources"][source])) for row in rows]),
            f"{1e-3 * median(row['sources'][source]['action_us'][0] for row in rows):.2f}",
        )
        for source in (UNGUARDED, KNOWN, CAMERAS, UNKNOWN_OCCUPIED)
    ]
    return [f"### {policy}", "", *markdown_table(head, cells), ""]


def _cost_section(rows: list[Row]) -> list[str]:
    head = ["obstacles", "images", "occupied voxels", "boxes", "most clearance lost to boxes [mm]", "per image [ms]"]
    cells = [
        (
            source,
            sum(one["images"] for one in found),
            f"{median(one['voxels'] for one in found):.0f}",
            f"{median(one['boxes'] for one in found):.0f}",
            f"{1e3 * max(one['lost'] for one in found):.0f}",
            f"{median(one['image_ms'] for one in found):.0f}",
        )
        for source in (CAMERAS, UNKNOWN_OCCUPIED)
        if (found := [row["sources"][source] for row in rows])
    ]
    return ["### Images", "", *markdown_table(head, cells), ""]


@cache
def _open_scene(seed: int) -> GuardScene:
    return make_scene(seed)
