"""Scene families of level II: the same task, but the parameters of the contract decide whether it is feasible.

In level I, an arm with clearance prediction finds a path for every contract. In level II, some contracts are infeasible
for a reason that is visible in the scene:

- `tall_ii`: the cube is in a row, so that the fingers fit on one axis only; mostly the gaps are too narrow for fully
  open fingers. A screen blocks the direct path or the path close to the base, except for an object carried above it.
- `shelf_ii`: a board is low above the path (free space only above it), directly behind the cube, or over the bowl
  (free space only below it, for the wrist and a low approach).
- `forearm_ii`: a person works at the bowl for some time: from the start, from the time at which the robot carries the
  cube, or for very long. A contract that waits too early or arrives at the wrong time exceeds its waiting time.

The seed selects the hazards in turn, so that consecutive seeds cover all of them; the rest is random. Gaps are 4-8 cm,
and at least 4.2 cm next to flat objects that only half-open fingers pass.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from dualbrain.simulation.scenes.generators.draft import SceneDraft
from dualbrain.simulation.scenes.moving_person import person_path
from dualbrain.simulation.scenes.scene_spec import MovingPerson

BOARD_HALF_THICKNESS, BOARD_FAR_END_X = 0.01, 0.85
"""Half the thickness of a board, and x of its far end, which is on a post [m]."""
OPEN_FINGER_GAP_RANGE, HALF_OPEN_FINGER_GAP_RANGE = (0.055, 0.080), (0.042, 0.050)
"""Gaps between the cube and flat objects that open fingers pass, and gaps that only half-open fingers pass [m]."""


def _tall(draft: SceneDraft) -> None:
    """Hand-high objects at two opposite faces, flat objects at the others, and a screen on one of the two paths."""
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
    """Add a screen between cube and bowl that leaves either the direct path or the path close to the base free."""
    rng = draft.rng
    near, far = (0.26, 0.37) if rng.random() < 0.5 else (0.52, 0.80)
    y, half = rng.uniform(0.0, 0.06), rng.uniform(0.09, 0.13)
    add_screen(draft, y, half, near, far)


def add_screen(draft: SceneDraft, y: float, half: float, near: float, far: float) -> None:
    """Add an upright board across the path at `y`, from x = `near` to `far`, of half height `half` [m]."""
    draft.add_fixed_box("screen", ((far - near) / 2, 0.012, half), ((near + far) / 2, y, half), "screen")


def _shelf(draft: SceneDraft) -> None:
    """A board above the path, close behind the cube, or above the bowl, in turn."""
    rng = draft.rng
    draft.add_task_objects()
    location = ("path", "cube", "bowl")[draft.seed % 3]
    if location == "path":
        draft.add_neighbour(draft.random_height("low", "hand_high"))
        add_board(draft, 0.02, half=0.06, height=rng.uniform(0.26, 0.28), end_x=rng.uniform(0.30, 0.34))
    elif location == "cube":
        draft.add_beside_cube("low", int(rng.integers(4)), rng.uniform(*OPEN_FINGER_GAP_RANGE))
        add_board(draft, -0.22, half=0.10, height=rng.uniform(0.44, 0.48), end_x=rng.uniform(0.52, 0.56))
    else:
        draft.add_neighbour(draft.random_height("low", "hand_high"))
        add_board(draft, 0.26, half=0.10, height=rng.uniform(0.39, 0.44), end_x=rng.uniform(0.46, 0.49))
    draft.add_scattered(2, "low")


def add_board(draft: SceneDraft, y: float, *, half: float, height: float, end_x: float) -> None:
    """Add a board on a post: from the far side to x = `end_x`, of half width `half`, at `height` [m]."""
    below = (height - BOARD_HALF_THICKNESS) / 2
    draft.add_fixed_box(
        "shelf",
        ((BOARD_FAR_END_X - end_x) / 2, half, BOARD_HALF_THICKNESS),
        ((end_x + BOARD_FAR_END_X) / 2, y, height),
        "shelf",
    )
    draft.add_fixed_box("shelf_post", (0.015, half, below), (BOARD_FAR_END_X - 0.015, y, below), "shelf")


def _forearm(draft: SceneDraft) -> None:
    """A forearm rests at the bowl: from before the start, from the time the robot carries the cube, or very long."""
    rng = draft.rng
    draft.add_task_objects()
    draft.add_neighbour("hand_high")
    draft.add_scattered(int(rng.integers(1, 3)), "low")
    arrival, departure = (
        (rng.uniform(-8.0, -2.0), rng.uniform(10.0, 20.0)),
        (rng.uniform(8.0, 14.0), rng.uniform(26.0, 34.0)),
        (rng.uniform(-2.0, 0.0), rng.uniform(25.0, 31.0)),
    )[draft.seed % 3]
    draft.mover = _visiting_forearm(draft, float(arrival), float(departure))


def _visiting_forearm(draft: SceneDraft, arrival: float, departure: float) -> MovingPerson:
    """A forearm that enters from a side of the table and rests at the bowl from `arrival` to `departure` [s]."""
    rng = draft.rng
    x, z = float(rng.uniform(0.42, 0.50)) + 0.295, float(rng.uniform(0.165, 0.22))
    outside, inside = 0.60 if rng.random() < 0.5 else -0.60, float(rng.uniform(0.16, 0.28))
    forearm = MovingPerson(
        start=(x, outside, z),
        end=(x, inside, z),
        speed=float(rng.uniform(0.10, 0.15)),
        pause=departure - arrival,
        phase=0.0,
    )
    path = person_path(forearm)
    return msgspec.structs.replace(forearm, phase=(path.pause + path.travel - arrival) % path.cycle_duration)


OBSTRUCTED_FAMILIES: dict[str, Callable[[SceneDraft], None]] = {
    "tall_ii": _tall,
    "shelf_ii": _shelf,
    "forearm_ii": _forearm,
}
"""Scene families of level II with obstructed paths, by name."""
