"""What may be taught and what is kept for measuring, fixed before anything was fitted."""

from __future__ import annotations

from typing import Literal

Split = Literal["teach", "check", "test"]
"""Taught; asked while fitting, to tell when to stop; never shown to a fit, nor used to choose anything in it."""

SCENE_SEEDS: dict[Split, range] = {
    "teach": range(50_000, 59_000),
    "check": range(59_000, 60_000),
    "test": range(60_000, 61_000),
}
"""Seeds of the scenes of each part; the evaluation's are all below 50 000."""
TABLE_FAMILIES = (
    "bare",
    "tabletop",
    "tall",
    "shelf",
    "forearm",
    "edge",
    "fragile",
    "tall_ii",
    "shelf_ii",
    "forearm_ii",
)
ROOM_FAMILIES = ("empty_room", "boxes", "crossing")
"""Families that lessons are drawn from, by name: families that come later change no lesson."""
HELD_OUT_FAMILY = "edge"
"""No scene of this task family is taught or checked with."""
HELD_OUT_CATEGORIES = frozenset({"carton", "bottle"})
"""Nothing of these categories stands in a scene that is taught or checked with."""
TEMPLATES_HASH = "2cf50b750cdf7214"
"""Hash of the world's wordings, whose held-out sentences only the part "test" uses."""
LESSONS_SHA256 = "7fd54b7f0c868fc2140426182d5349847059aa4e2c706e2526e05d927196de42"
"""Of `templates.toml`: skeletons, words for what is not there, and sentences, held-out ones among them."""


def is_scene_allowed(split: Split, family: str, categories: frozenset[str]) -> bool:
    """Whether a scene of `family` with things of these `categories` may be used for `part`."""
    return split == "test" or (family != HELD_OUT_FAMILY and not categories & HELD_OUT_CATEGORIES)
