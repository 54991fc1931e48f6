"""Classes of the experiment `speed_limits`: robot, filter, and the limits that each state is judged by."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.obstacles import NearSpeed

HELD = ((0.0, 0.0, 0.1, 0.03), (0.0, 0.06, 0.2, 0.03))
"""A grasped object as spheres in the tool frame: x, y, z, radius [m]."""
NEAR = NearSpeed(speed=0.1, distance=0.25, brake=1.0)
"""The limit near a person."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedClass:
    """One configuration: the filter, the scene, and the limits by which a judge measures every step."""

    name: str
    description: str
    robot: str = "panda"
    limit: float | None = None
    """Largest speed of every part [m/s]."""
    near: NearSpeed | None = None
    """Limit of the parts near a person, who is within reach."""
    holds_object: bool = False
    """Whether the judge measures a grasped object."""
    knows_object: bool = True
    """Whether the filter knows it; a negative control does not."""
    judges_jerk: bool = False
    evades: bool = False
    """A moving obstacle attacks the arm at 0.8 m/s."""
    filter_settings: dict[str, Any] = field(default_factory=dict[str, Any])
    knows_near: bool = True
    """Whether the filter has the limit near the person; a negative control has not."""
    compared_with: str = ""
    """For a negative control: the complete class, which holds."""

    def filter_config(self) -> FilterConfig:
        """The filter without lag and tracking error, because joints in these loops integrate the control exactly."""
        return FilterConfig(lag_compensation=False, tracking_error=0.0, **self.filter_settings)


def _limited(name: str, description: str, limit: float, **changes: Any) -> SpeedClass:
    settings = {"cartesian_speed": limit} | changes.pop("filter_settings", {})
    return SpeedClass(name=name, description=description, limit=limit, filter_settings=settings, **changes)


COMPLETE_CLASSES = (
    _limited("limit", "every part at most 0.25 m/s among obstacles", 0.25),
    _limited("limit, UR5e", "every part at most 0.4 m/s among obstacles", 0.4, robot="ur5e"),
    _limited("small limit", "every part at most 0.05 m/s", 0.05),
    _limited("load", "as limit, with a grasped object of 20 cm", 0.25, holds_object=True),
    _limited(
        "jerk",
        "as limit, with the jerk limits of the joints",
        0.25,
        judges_jerk=True,
        filter_settings={"jerk_limits": True},
    ),
    _limited("evading", "as limit, while an obstacle attacks at 0.8 m/s", 0.25, evades=True),
    _limited("evading, UR5e", "the same with the UR5e", 0.25, evades=True, robot="ur5e"),
    SpeedClass(name="person", description="parts within 25 cm of a person at most 0.1 m/s", near=NEAR),
    SpeedClass(name="person, UR5e", description="the same with the UR5e", near=NEAR, robot="ur5e"),
    _limited(
        "person, load",
        "as person, with a grasped object, and every part at most 0.4 m/s",
        0.4,
        near=NEAR,
        holds_object=True,
    ),
)
_BY_NAME = {one.name: one for one in COMPLETE_CLASSES}


def _without(name: str, of: str, description: str, **changes: Any) -> SpeedClass:
    return replace(_BY_NAME[of], name=name, description=description, compared_with=of, **changes)


NEGATIVE_CONTROLS = (
    _without("no limit", "limit", "limit, with a filter without it", filter_settings={}),
    _without("no limit for the load", "load", "load, with a filter that does not know the object", knows_object=False),
    _without("no jerk limit", "jerk", "jerk, with a filter without it", filter_settings={"cartesian_speed": 0.25}),
    _without("no limit while evading", "evading", "evading, with a filter without the limit", filter_settings={}),
    _without("no limit near the person", "person", "person, with a filter without it", knows_near=False),
)
CLASSES = {one.name: one for one in (*COMPLETE_CLASSES, *NEGATIVE_CONTROLS)}
