"""Generator of tables for tasks with several goals: red and other objects, and a deep bowl that may be occupied.

The tasks are ordered goals, all objects of a colour, and goals that depend on whether the bowl is free. The bowl is
deep enough for several objects. Two or three objects are red; for odd seeds a tin is in the bowl.
"""

from __future__ import annotations

from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder
from dualbrain.simulation.scenes.generators.draft import SceneDraft, yaw_quaternion
from dualbrain.simulation.scenes.scene_spec import ObjectSpec

DEEP_BOWL = Bowl(radius=0.11, height=0.09, wall=0.004)
BLOCK, TIN = Box((0.02, 0.022, 0.02)), Cylinder(0.022, 0.022)
BOWL_BOTTOM_CLEARANCE = 0.008
"""Initial height of an object in the bowl above the bottom of the bowl [m]."""


def sorting_scene(draft: SceneDraft) -> None:
    """The red cube, a red block, sometimes a red tin, two other objects, and the deep bowl, free or occupied."""
    rng = draft.rng
    draft.add_cube(0.50 + rng.uniform(-0.02, 0.02), -0.24 + rng.uniform(-0.02, 0.02), rng.uniform(-0.25, 0.25))
    x, y = 0.50 + rng.uniform(-0.02, 0.02), 0.24 + rng.uniform(-0.02, 0.02)
    draft.objects.append(
        ObjectSpec(
            name="blue_bowl",
            role="container",
            shape=DEEP_BOWL,
            position=(x, y, 0.0),
            mass=0.4,
            colour="blue",
            category="bowl",
        )
    )
    _add_at_free_spot(draft, "red_block", "block", "red", BLOCK)
    if rng.random() < 0.5:
        _add_at_free_spot(draft, "red_tin", "tin", "red", TIN)
    _add_at_free_spot(draft, "yellow_block", "block", "yellow", BLOCK)
    if draft.seed % 2:
        inside = (x, y, BOWL_BOTTOM_CLEARANCE + TIN.half_height)
        draft.objects.append(
            ObjectSpec(
                name="green_tin", role="object", shape=TIN, position=inside, mass=0.10, colour="green", category="tin"
            )
        )
    else:
        _add_at_free_spot(draft, "green_tin", "tin", "green", TIN)


def _add_at_free_spot(draft: SceneDraft, name: str, category: str, colour: str, shape: Box | Cylinder) -> None:
    """Add one object at a free spot with room for a hand around it."""
    half = shape.half_extents[2] if isinstance(shape, Box) else shape.half_height
    x, y = draft.find_free_spot((0.36, 0.62), (-0.36, 0.06), 0.03, 0.07)
    yaw = draft.rng.uniform(-0.4, 0.4)
    draft.objects.append(
        ObjectSpec(
            name=name,
            role="object",
            shape=shape,
            position=(float(x), float(y), half),
            mass=0.10,
            colour=colour,
            category=category,
            quaternion=yaw_quaternion(yaw),
        )
    )
