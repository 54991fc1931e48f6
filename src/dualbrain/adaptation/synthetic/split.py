"""The split of synthetic examples into training, check and test parts, fixed before any training."""

from __future__ import annotations

from typing import Literal

Split = Literal["teach", "check", "test"]
"""Part of the split: training ("teach"), evaluation during training ("check"), and test only ("test"). The names seed
the random generator of the examples, so they must not change."""

TRAINING_PART: Split = "teach"
TEST_PART: Split = "test"

SCENE_SEEDS: dict[Split, range] = {
    "teach": range(50_000, 59_000),
    "check": range(59_000, 60_000),
    "test": range(60_000, 61_000),
}
"""Seeds of the scenes of each part; the seeds of the evaluation are all below 50 000."""
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
"""Scene families of the examples by name: families that are added later change no example."""
HELD_OUT_FAMILY = "edge"
"""Task family that only the part "test" uses."""
HELD_OUT_CATEGORIES = frozenset({"carton", "bottle"})
"""Object categories that only scenes of the part "test" contain."""
TEMPLATES_HASH = "2cf50b750cdf7214"
"""Hash of the instruction templates of the simulation; only the part "test" uses their held-out sentences."""
TEMPLATE_FILE_SHA256 = "41dc18e431a5e40ded5a027621cdaeac9537c1d964f4706d0b23d189b7899415"
"""SHA-256 of `templates.toml`: contract skeletons, words for absent objects, and sentences with held-out ones."""


def is_scene_allowed(split: Split, family: str, categories: frozenset[str]) -> bool:
    """Whether the part `split` may use a scene of `family` with objects of these `categories`."""
    return split == "test" or (family != HELD_OUT_FAMILY and not categories & HELD_OUT_CATEGORIES)
