"""Families of level II: the same errand where the contract decides whether it can be done at all.

In level I an arm that looks ahead finds some way whatever the contract says. Here the room is such that a contract can
shut itself out, each time for a reason one can see on the table:

- `tall_ii`: the cube stands in a row, so that fingers fit on one axis only, and mostly so tight that wide open ones do
  not fit at all; a screen blocks the straight way or the way close to the base, unless carried above it.
- `shelf_ii`: a board hangs low over the way (only above it there is room), right behind the cube or over the bowl
  (only below it there is room for the wrist, and for a hand that comes in low).
- `forearm_ii`: somebody works at the bowl for a while: is there when the robot starts, comes when it carries, or stays
  long. Contracts that wait too early or arrive at the wrong time use up their patience.

Which of its hazards a scene has goes round with the seed, so that consecutive seeds show all; everything else is
drawn. Gaps are 4-8 cm, and at least 4.2 cm beside the flat things that only half-open fingers pass.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from dualbrain.simulation.scenes.generators.draft import SceneDraft
from dualbrain.simulation.scenes.moving_person import person_path
from dualbrain.simulation.scenes.scene_spec import MovingPerson

BOARD_HALF_THICKNESS, BOARD_FAR_END_X = 0.01, 0.85
"""Half a board's thickness, and where it ends, on its post [m]."""
OPEN_FINGER_GAP_RANGE, HALF_OPEN_FINGER_GAP_RANGE = (0.055, 0.080), (0.042, 0.050)
"""Gap between the cube and flat things that open fingers pass, and one that only half-open fingers pass [m]."""


def _tall(draft: SceneDraft) -> None:
    """Hand-high things at two opposite faces, flat ones at the others, and a screen on one of the two ways."""
    rng = draft.rng
    draft.add_task_objects()
    flanked, squeezed = draft.seed % 2, draft.seed % 3 != 1
    for face in (flanked, flanked + 2):
        draft.add_beside_cube("hand_high", face, rng.uniform(0.04, 0.07))
    for face in (flanked + 1, flanked + 3) if squeezed else (flanked + 1,):
        draft.add_beside_cube(
            "flat", face, rng.uniform(*(HALF_OPEN_FINGER_GAP_RANGE if squeezed else OPEN_FINGER_GAP_RANGE))
        )
    _add_random_screen(draft)


def _add_random_screen(draft: SceneDraft) -> None:
    """An upright board between cube and bowl that leaves the straight way free, or the one close to the base."""
    rng = draft.rng
    near, far = (0.26, 0.37) if rng.random() < 0.5 else (0.52, 0.80)
    y, half = rng.uniform(0.0, 0.06), rng.uniform(0.09, 0.13)
    add_screen(draft, y, half, near, far)


def add_screen(draft: SceneDraft, y: float, half: float, near: float, far: float) -> None:
    """An upright board across the way at `y`, from x = `near` to `far`, `half` its height [m]."""
    draft.add_fixed_box("screen", ((far - near) / 2, 0.012, half), ((near + far) / 2, y, half), "screen")


def _shelf(draft: SceneDraft) -> None:
    """A board over the way, close behind the cube, or over the bowl, in turn."""
    rng = draft.rng
    draft.add_task_objects()
    at = ("way", "cube", "bowl")[draft.seed % 3]
    if at == "way":
        draft.add_neighbour(draft.random_height("low", "hand_high"))
        add_board(draft, 0.02, half=0.06, height=rng.uniform(0.26, 0.28), end_x=rng.uniform(0.30, 0.34))
    elif at == "cube":
        draft.add_beside_cube("low", int(rng.integers(4)), rng.uniform(*OPEN_FINGER_GAP_RANGE))
        add_board(draft, -0.22, half=0.10, height=rng.uniform(0.44, 0.48), end_x=rng.uniform(0.52, 0.56))
    else:
        draft.add_neighbour(draft.random_height("low", "hand_high"))
        add_board(draft, 0.26, half=0.10, height=rng.uniform(0.39, 0.44), end_x=rng.uniform(0.46, 0.49))
    draft.add_scattered(2, "low")


def add_board(draft: SceneDraft, y: float, *, half: float, height: float, end_x: float) -> None:
    """A board on a post: from the far side to x = `tip`, `half` its width, at `height` [m]."""
    below = (height - BOARD_HALF_THICKNESS) / 2
    draft.add_fixed_box(
        "shelf",
        ((BOARD_FAR_END_X - end_x) / 2, half, BOARD_HALF_THICKNESS),
        ((end_x + BOARD_FAR_END_X) / 2, y, height),
        "shelf",
    )
    draft.add_fixed_box("shelf_post", (0.015, half, below), (BOARD_FAR_END_X - 0.015, y, below), "shelf")


def _forearm(draft: SceneDraft) -> None:
    """A forearm that rests at the bowl: from before the start, from when the robot carries, or very long."""
    rng = draft.rng
    draft.add_task_objects()
    draft.add_neighbour("hand_high")
    draft.add_scattered(int(rng.integers(1, 3)), "low")
    comes, leaves = (
        (rng.uniform(-8.0, -2.0), rng.uniform(10.0, 20.0)),
        (rng.uniform(8.0, 14.0), rng.uniform(26.0, 34.0)),
        (rng.uniform(-2.0, 0.0), rng.uniform(25.0, 31.0)),
    )[draft.seed % 3]
    draft.mover = _visiting_forearm(draft, float(comes), float(leaves))


def _visiting_forearm(draft: SceneDraft, comes: float, leaves: float) -> MovingPerson:
    """In from a side of the table, resting at the bowl from time `comes` to `leaves` [s], and out again."""
    rng = draft.rng
    x, z = float(rng.uniform(0.42, 0.50)) + 0.295, float(rng.uniform(0.165, 0.22))
    outside, inside = 0.60 if rng.random() < 0.5 else -0.60, float(rng.uniform(0.16, 0.28))
    still = MovingPerson(
        start=(x, outside, z), end=(x, inside, z), speed=float(rng.uniform(0.10, 0.15)), pause=leaves - comes, phase=0.0
    )
    path = person_path(still)
    return msgspec.structs.replace(still, phase=(path.pause + path.travel - comes) % path.cycle_duration)


OBSTRUCTED_FAMILIES: dict[str, Callable[[SceneDraft], None]] = {
    "tall_ii": _tall,
    "shelf_ii": _shelf,
    "forearm_ii": _forearm,
}
"""Families of level II by name."""
