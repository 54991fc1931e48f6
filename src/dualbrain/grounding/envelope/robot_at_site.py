"""The robot with everything that its site file states: limits, obstacles, persons, objects and grants."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dualbrain.grounding.envelope.object_limits import site_object_limits
from dualbrain.records import ObjectLimits
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.robots.site_config import read_site
from dualbrain.safety.cbf.obstacles import Obstacle, PersonLimits
from dualbrain.safety.integration.site import site_obstacles, site_persons, site_robot, site_skill_grants
from dualbrain.skills.registry import skill_registry


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotAtSite:
    """The robot with the limits of its site, and obstacles, limits of persons and objects, and grants of the site.

    `model_without_site` is the robot model as it was loaded: the memory normalises postures with its limits, so that
    one memory serves runs with any site.
    """

    robot_model: RobotModel
    model_without_site: RobotModel
    fixed_obstacles: tuple[Obstacle, ...] = ()
    persons: PersonLimits | None = None
    object_limits: Mapping[str, ObjectLimits] = field(default_factory=dict[str, ObjectLimits])
    grants: Mapping[str, frozenset[str]] | None = None


def open_robot_at_site(robot: str, site: Path | None = None) -> RobotAtSite:
    """The robot called `robot` at the site of the file `site`, or without a site.

    Raises:
        UnknownNameError: there is no such robot.
        SiteError: the file is invalid, or does not fit the robot.
    """
    loaded = load_robot(robot)
    if site is None:
        return RobotAtSite(robot_model=loaded, model_without_site=loaded)
    file = read_site(site)
    robot_model = site_robot(loaded, file)
    registry = skill_registry(robot_model)
    return RobotAtSite(
        robot_model=robot_model,
        model_without_site=loaded,
        fixed_obstacles=site_obstacles(robot_model, file),
        persons=site_persons(file),
        object_limits=site_object_limits(file, registry),
        grants=site_skill_grants(file, frozenset(registry.by_name)),
    )
