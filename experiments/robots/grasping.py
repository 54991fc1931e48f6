"""picks: forty seeded grasps of whatever stands free on an everyday table, held by contact alone."""

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
"""How high the fingers' tips rise above the table [m], how long the thing must then stay up [s]."""
MIN_RAISE = 0.10
"""A held thing is at least this far above where it stood [m] …"""
MAX_TOOL_DISTANCE = 0.05
"""… and its middle this close to the tool [m], or the thing is taller than that."""
MIN_FINGER_CLEARANCE, CORRIDOR_HALF_WIDTH = 0.08, 0.05
"""Free room a side wants along the finger axis, and half the corridor's breadth in which something would matter [m]."""
MAX_OBJECT_WIDTH = 0.07


def grasp_candidates(spec: SceneSpec) -> list[tuple[float, str, str]]:
    """(room [m], thing, finger axis) for everything that fits between the fingers, most room first."""
    found = [
        (_free_space(spec, thing, axis), thing.name, ("along", "across")[axis])
        for thing in spec.objects
        if thing.role == "object"
        for axis in (0, 1)
        if _width(thing, axis) <= MAX_OBJECT_WIDTH
    ]
    return sorted(found, reverse=True)


def _width(thing: ObjectSpec, axis: int) -> float:
    shape = thing.shape
    return 2.0 * (shape.half_extents[axis] if isinstance(shape, Box) else footprint_radius(shape))


def _free_space(spec: SceneSpec, thing: ObjectSpec, axis: int) -> float:
    """Least gap to anything in the corridor along the finger axis; beside the corridor nothing counts."""
    axes = quaternion_to_matrix(thing.quaternion)
    gaps = [1.0]
    for other in spec.objects:
        away = np.subtract(other.position, thing.position)
        along, aside = abs(float(away @ axes[:, axis])), abs(float(away @ axes[:, 1 - axis]))
        reach = footprint_radius(other.shape)
        if other is not thing and aside < CORRIDOR_HALF_WIDTH + reach:
            gaps.append(along - reach - _width(thing, axis) / 2)
    return min(gaps)


def check_lift(plant: Plant, name: str) -> tuple[bool, float]:
    """Whether truth says that the thing hangs in the hand, and how far it was raised [m]."""
    at, thing = np.array(plant.true_pose(name).position), plant.spec.find(name)
    tool, _ = plant.tool_pose()
    raised = float(at[2] - thing.position[2])
    return raised > MIN_RAISE and float(np.linalg.norm((at - tool)[:2])) < MAX_TOOL_DISTANCE, raised


class Grasping:
    """Contact-only grasping works."""

    name = "grasping"
    claim = "At least 38 of 40 seeded picks (tabletop, things with a free side, from above, 20 N) are lifted and held."

    def units(self, options: Options) -> list[WorkUnit]:
        """One unit a seed."""
        del options
        return [WorkUnit(f"tabletop:{seed}", {"seed": seed}) for seed in SEEDS]

    def run(self, about: dict[str, Any]) -> Row:
        """Choose by seed among what stands free, grasp, stand still for a second, look at truth."""
        seed = about["seed"]
        spec = make_scene("tabletop", seed)
        ranked = grasp_candidates(spec)
        free = [choice for choice in ranked if choice[0] >= MIN_FINGER_CLEARANCE] or ranked[:1]
        room, name, axis = free[int(np.random.default_rng([seed, 7]).integers(len(free)))]
        grasp = {**GRASP_PARAMETERS, "object": name, "finger_axis": axis, "clearance": LIFT_HEIGHT}
        actions = [{"skill": "grasp", "params": grasp}, {"skill": "hold", "params": {"duration": HOLD_DURATION}}]
        flight = run_contract(spec, actions, seed=seed, goal=None)
        up, raised = check_lift(flight.plant, name)
        return {**run_row(flight), "truth": up, "raised": raised, "thing": name, "finger_axis": axis, "room": room}

    def summarize_row(self, row: Row) -> str:
        """Thing and end."""
        return f"{row['thing']} {row['finger_axis']}: {describe_outcome(row)}"

    def report(self, rows: list[Row]) -> list[str]:
        """The count, and every pick that failed."""
        good = [row for row in rows if row.get("truth")]
        lost = [row for row in rows if not row.get("truth")]
        lines = [
            f"Lifted and held on truth: **{format_proportion(len(good), len(rows))}**; wanted: at least 38 of 40.",
            "",
        ]
        lines += [f"Violations: {dict(count_violations(rows)) or 'none'}.", ""]
        if lost:
            cells = (
                (r["key"], r["thing"], r["finger_axis"], f"{r['room'] * 100:.0f} cm", r.get("reason", "")) for r in lost
            )
            lines += markdown_table(("scene", "thing", "finger axis", "free room", "why it failed"), cells)
        return lines
