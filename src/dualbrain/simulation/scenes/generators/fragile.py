"""Scene families of level II with objects that may fall or break.

- `edge_ii`: the cube overhangs the left or right edge of the table. The fingers fit on one axis only, because hand-high
  objects are next to the cube along the edge, or one is at its inner face. A screen blocks one of the two paths to the
  bowl, or a board above the cube leaves room only for a low approach.
- `fragile_ii`: the task is to move a glass upright to a coaster. Thin and ordinary glasses break above a force that
  differs between scenes; a thick glass is full and wet, and slips out of a grip that is gentle enough for the others.
  The glass is in a row like the cube of `tall_ii`, and a screen blocks one of the two paths.

The seed selects the hazards in turn; the rest is random. Gaps are 4-8 cm, as in `obstructed_tabletop`.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from dualbrain.core.geometry.shapes import Cylinder
from dualbrain.records import Place
from dualbrain.simulation.scenes.generators.draft import CUBE, TABLE_PLACES, SceneDraft
from dualbrain.simulation.scenes.generators.obstructed_tabletop import (
    HALF_OPEN_FINGER_GAP_RANGE,
    OPEN_FINGER_GAP_RANGE,
    add_board,
    add_screen,
)
from dualbrain.simulation.scenes.scene_spec import TABLE_Y, ObjectSpec

GLASS = Cylinder(radius=0.024, half_height=0.045)
COASTER = Place("coaster", (0.50, 0.26, 0.0))
"""Destination of the glass, and the only place of its scenes."""
FRONT_PLACES = TABLE_PLACES[2:]
"""The places of a table with objects at its left and right edges."""
FRAGILE_LIMIT_RANGES = ((13.0, 16.0), (17.0, 20.0), (50.0, 60.0))
"""Ranges of the force that breaks a glass [N]: thin, ordinary and thick glasses, in turn."""
DRY_GLASS, WET_GLASS = (0.08, 0.8), (0.28, 0.12)
"""Mass [kg] and friction of an empty glass, and of a full glass that is wet outside: 10 N per finger hold 2.4 N."""


def _edge(draft: SceneDraft) -> None:
    """The cube overhangs an edge by 30-42 % of its width, with a row, a wall or a board next to it, in turn."""
    rng, draft.places = draft.rng, FRONT_PLACES
    side = 1.0 if rng.random() < 0.5 else -1.0
    outside = rng.uniform(0.30, 0.42)
    draft.add_cube(rng.uniform(0.28, 0.35), side * (TABLE_Y[1] - 2 * CUBE.half_extents[1] * (0.5 - outside)), 0.0)
    draft.add_bowl()
    inner = 1 if side < 0.0 else 3
    hazard = ("row", "wall", "board")[draft.seed % 3]
    if hazard == "row":
        for face in (0, 2):
            draft.add_beside_cube("hand_high", face, rng.uniform(0.045, 0.07))
        draft.add_beside_cube(
            "flat", inner, rng.uniform(*(HALF_OPEN_FINGER_GAP_RANGE if rng.random() < 0.5 else OPEN_FINGER_GAP_RANGE))
        )
    elif hazard == "wall":
        draft.add_beside_cube("hand_high", inner, rng.uniform(0.045, 0.07))
        draft.add_beside_cube("flat", 0 if rng.random() < 0.5 else 2, rng.uniform(*HALF_OPEN_FINGER_GAP_RANGE))
    else:
        draft.add_beside_cube("low", inner, rng.uniform(*OPEN_FINGER_GAP_RANGE))
        add_board(draft, side * 0.58, half=0.10, height=rng.uniform(0.42, 0.46), end_x=rng.uniform(0.36, 0.40))
    if hazard != "board":
        _add_screen_before_bowl(draft, side)


def _add_screen_before_bowl(draft: SceneDraft, side: float) -> None:
    """Add a screen between edge and bowl that leaves either the direct path or the path close to the base free."""
    near, far = (0.14, 0.30) if draft.rng.random() < 0.5 else (0.40, 0.70)
    add_screen(draft, 0.44 if side > 0.0 else -0.30, draft.rng.uniform(0.09, 0.13), near, far)


def _fragile(draft: SceneDraft) -> None:
    """A glass in a row between hand-high objects, and a screen on its path to the coaster."""
    rng = draft.rng
    draft.places = (COASTER,)
    position = (0.50 + float(rng.uniform(-0.02, 0.02)), -0.22 + float(rng.uniform(-0.02, 0.02)), GLASS.half_height)
    limit = round(float(rng.uniform(*FRAGILE_LIMIT_RANGES[draft.seed % 3])), 1)
    mass, friction = WET_GLASS if draft.seed % 3 == 2 else DRY_GLASS
    glass = ObjectSpec(
        name="clear_glass",
        role="object",
        shape=GLASS,
        position=position,
        mass=mass,
        colour="clear",
        category="glass",
        friction=friction,
    )
    draft.objects.append(msgspec.structs.replace(glass, fragile_limit=limit))
    flanked = draft.seed % 2
    for face in (flanked, flanked + 2):
        draft.add_beside_cube("hand_high", face, rng.uniform(0.045, 0.07))
    draft.add_beside_cube(
        "flat", flanked + 1, rng.uniform(*(HALF_OPEN_FINGER_GAP_RANGE if rng.random() < 0.5 else OPEN_FINGER_GAP_RANGE))
    )
    near, far = (0.26, 0.37) if rng.random() < 0.5 else (0.52, 0.80)
    add_screen(draft, rng.uniform(0.0, 0.06), rng.uniform(0.09, 0.13), near, far)


FRAGILE_FAMILIES: dict[str, Callable[[SceneDraft], None]] = {"edge_ii": _edge, "fragile_ii": _fragile}
"""Scene families of level II with objects that may fall or break, by name."""
