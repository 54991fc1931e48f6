"""Forty seeded grasps of objects with free space on a cluttered table, held by contact forces alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import footprint_radius, make_scene
from dualbrain.simulation.scenes.scene_spec import ObjectSpec, SceneSpec
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table
from experiments.safety.closed_loop import GRASP_PARAMETERS, count_violations, describe_outcome, run_contract, run_row

SEEDS = range(40)
LIFT_HEIGHT, HOLD_DURATION = 0.15, 1.0
"""Height of the fingertips above the table after the lift [m], and time for which the object must then be held [s]."""
MIN_RAISE = 0.10
"""A held object is at least this far above its initial position [m] …"""
MAX_TOOL_DISTANCE = 0.05
"""… and its centre is horizontally this close to the tool [m]."""
MIN_FINGER_CLEARANCE, CORRIDOR_HALF_WIDTH = 0.08, 0.05
"""Free space required along the finger axis on each side, and half the width of the corridor that must be free [m]."""
MAX_OBJECT_WIDTH = 0.07


def grasp_candidates(spec: SceneSpec) -> list[tuple[float, str, str]]:
    """(free space [m], object, finger axis) for every object that fits between the fingers, most space first."""
    found = [
        (_free_space(spec, one, axis), one.name, ("along", "across")[axis])
        for one in spec.objects
        if one.role == "object"
        for axis in (0, 1)
        if _width(one, axis) <= MAX_OBJECT_WIDTH
    ]
    return sorted(found, reverse=True)


def _width(one: ObjectSpec, axis: int) -> float:
    shape = one.shape
    return 2.0 * (shape.half_extents[axis] if isinstance(shape, Box) else footprint_radius(shape))


def _free_space(spec: SceneSpec, one: ObjectSpec, axis: int) -> float:
    """Smallest gap to another object in the corridor along the finger axis [m]."""
    axes = quaternion_to_matrix(one.quaternion)
    gaps = [1.0]
    for other in spec.objects:
        offset = np.subtract(other.position, one.position)
        along, across = abs(float(offset @ axes[:, axis])), abs(float(offset @ axes[:, 1 - axis]))
        reach = footprint_radius(other.shape)
        if other is not one and across < CORRIDOR_HALF_WIDTH + reach:
            gaps.append(along - reach - _width(one, axis) / 2)
    return min(gaps)


def check_lift(plant: Plant, name: str) -> tuple[bool, float]:
    """Whether the gripper holds the object on ground truth, and how far it was raised [m]."""
    position, initial = np.array(plant.true_pose(name).position), plant.spec.find(name).position
    tool, _ = plant.tool_pose()
    raised = float(position[2] - initial[2])
    return raised > MIN_RAISE and float(np.linalg.norm((position - tool)[:2])) < MAX_TOOL_DISTANCE, raised


class Grasping:
    """Grasping by contact forces alone works."""

    name = "grasping"
    claim = "At least 38 of 40 seeded picks (tabletop, objects with a free side, from above, 20 N) are lifted and held."

    def units(self, options: Options) -> list[WorkUnit]:
        """One unit per seed."""
        del options
        return [WorkUnit(f"tabletop:{seed}", {"seed": seed}) for seed in SEEDS]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Grasp an object with free space, chosen by seed, hold it for a second, and judge by ground truth."""
        seed = parameters["seed"]
        spec = make_scene("tabletop", seed)
        ranked = grasp_candidates(spec)
        free = [choice for choice in ranked if choice[0] >= MIN_FINGER_CLEARANCE] or ranked[:1]
        space, name, axis = free[int(np.random.default_rng([seed, 7]).integers(len(free)))]
        grasp = {**GRASP_PARAMETERS, "object": name, "finger_axis": axis, "clearance": LIFT_HEIGHT}
        actions = [{"skill": "grasp", "params": grasp}, {"skill": "hold", "params": {"duration": HOLD_DURATION}}]
        run = run_contract(spec, actions, seed=seed, goal=None)
        held, raised = check_lift(run.plant, name)
        return {**run_row(run), "truth": held, "raised": raised, "thing": name, "finger_axis": axis, "room": space}

    def summarize_row(self, row: Row) -> str:
        """The object and the outcome."""
        return f"{row['thing']} {row['finger_axis']}: {describe_outcome(row)}"

    def report(self, rows: list[Row]) -> list[str]:
        """The count, and every pick that failed."""
        good = [row for row in rows if row.get("truth")]
        failed = [row for row in rows if not row.get("truth")]
        share = format_proportion(len(good), len(rows))
        lines = [f"Lifted and held on ground truth: **{share}**; required: at least 38 of 40.", ""]
        lines += [f"Violations: {dict(count_violations(rows)) or 'none'}.", ""]
        if failed:
            cells = (
                (r["key"], r["thing"], r["finger_axis"], f"{r['room'] * 100:.0f} cm", r.get("reason", ""))
                for r in failed
            )
            lines += markdown_table(("scene", "object", "finger axis", "free space", "reason"), cells)
        return lines
