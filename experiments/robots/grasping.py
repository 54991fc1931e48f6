"""picks: forty seeded grasps of whatever stands free on an everyday table, held by contact alone."""

from __future__ import annotations

from typing import Any

import numpy as np

from dualbrain.core.geometry.rotations import matrix
from dualbrain.core.geometry.shapes import Box
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import footprint, make_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec, Thing
from experiments.engine.experiment import Options, Row, Unit
from experiments.figures.tables import share, table
from experiments.safety.closed_loop import GRASP, fly, kinds, outcome_words, row

SEEDS = range(40)
LIFT, HOLD = 0.15, 1.0
"""How high the fingers' tips rise above the table [m], how long the thing must then stay up [s]."""
RAISED = 0.10
"""A held thing is at least this far above where it stood [m] …"""
NEAR_TOOL = 0.05
"""… and its middle this close to the tool [m], or the thing is taller than that."""
FINGER_ROOM, HAND_DEPTH = 0.08, 0.05
"""Free room a side wants along the finger axis, and half the corridor's breadth in which something would matter [m]."""
WIDEST = 0.07


def choices(spec: SceneSpec) -> list[tuple[float, str, str]]:
    """(room [m], thing, finger axis) for everything that fits between the fingers, most room first."""
    found = [
        (_room(spec, thing, axis), thing.name, ("along", "across")[axis])
        for thing in spec.things if thing.role == "object"
        for axis in (0, 1) if _width(thing, axis) <= WIDEST
    ]  # fmt: skip
    return sorted(found, reverse=True)


def _width(thing: Thing, axis: int) -> float:
    shape = thing.shape
    return 2.0 * (shape.half_extents[axis] if isinstance(shape, Box) else footprint(shape))


def _room(spec: SceneSpec, thing: Thing, axis: int) -> float:
    """Least gap to anything in the corridor along the finger axis; beside the corridor nothing counts."""
    axes = matrix(thing.quaternion)
    gaps = [1.0]
    for other in spec.things:
        away = np.subtract(other.position, thing.position)
        along, aside = abs(float(away @ axes[:, axis])), abs(float(away @ axes[:, 1 - axis]))
        reach = footprint(other.shape)
        if other is not thing and aside < HAND_DEPTH + reach:
            gaps.append(along - reach - _width(thing, axis) / 2)
    return min(gaps)


def held(plant: Plant, name: str) -> tuple[bool, float]:
    """Whether truth says that the thing hangs in the hand, and how far it was raised [m]."""
    at, thing = np.array(plant.truth(name).position), plant.spec.find(name)
    tool, _ = plant.tool_pose()
    raised = float(at[2] - thing.position[2])
    return raised > RAISED and float(np.linalg.norm((at - tool)[:2])) < NEAR_TOOL, raised


class Picks:
    """Contact-only grasping works."""

    name = "grasping"
    claim = "At least 38 of 40 seeded picks (tabletop, things with a free side, from above, 20 N) are lifted and held."

    def units(self, options: Options) -> list[Unit]:
        """One unit a seed."""
        del options
        return [Unit(f"tabletop:{seed}", {"seed": seed}) for seed in SEEDS]

    def run(self, about: dict[str, Any]) -> Row:
        """Choose by seed among what stands free, grasp, stand still for a second, look at truth."""
        seed = about["seed"]
        spec = make_scene("tabletop", seed)
        ranked = choices(spec)
        free = [choice for choice in ranked if choice[0] >= FINGER_ROOM] or ranked[:1]
        room, name, axis = free[int(np.random.default_rng([seed, 7]).integers(len(free)))]
        grasp = {**GRASP, "object": name, "finger_axis": axis, "clearance": LIFT}
        actions = [{"skill": "grasp", "params": grasp}, {"skill": "hold", "params": {"duration": HOLD}}]
        flight = fly(spec, actions, seed=seed, goal=None)
        up, raised = held(flight.plant, name)
        return {**row(flight), "truth": up, "raised": raised, "thing": name, "finger_axis": axis, "room": room}

    def brief(self, row: Row) -> str:
        """Thing and end."""
        return f"{row['thing']} {row['finger_axis']}: {outcome_words(row)}"

    def report(self, rows: list[Row]) -> list[str]:
        """The count, and every pick that failed."""
        good = [row for row in rows if row.get("truth")]
        lost = [row for row in rows if not row.get("truth")]
        lines = [f"Lifted and held on truth: **{share(len(good), len(rows))}**; wanted: at least 38 of 40.", ""]
        lines += [f"Violations: {dict(kinds(rows)) or 'none'}.", ""]
        if lost:
            cells = (
                (r["key"], r["thing"], r["finger_axis"], f"{r['room'] * 100:.0f} cm", r.get("reason", "")) for r in lost
            )
            lines += table(("scene", "thing", "finger axis", "free room", "why it failed"), cells)
        return lines
