"""The vocabulary of a robot by name, and the names that a scene offers to contracts."""

from __future__ import annotations

from pathlib import Path

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.records import Scene
from dualbrain.robots.loader import load_robot
from dualbrain.robots.site_config import read_site
from dualbrain.safety.integration.site import site_robot
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.skills.registry import skill_registry


def load_skill_registry(robot: str) -> SkillRegistry:
    """The registry of skills of `robot`; raises `UnknownName` with the known robots."""
    return skill_registry(load_robot(robot))


def skill_registry_at_site(robot: str, site: Path) -> SkillRegistry:
    """The registry of `robot` where the site file `site` holds; raises `UnknownName`, `SiteError`."""
    return skill_registry(site_robot(load_robot(robot), read_site(site)))


def planner_grants(registry: SkillRegistry) -> dict[str, frozenset[str]]:
    """Who may call what: the planner may call every registered skill."""
    return {PLANNER: frozenset(skill.name for skill in registry.skills)}


def scene_names(scene: Scene) -> SceneNames:
    """The names that a contract may use in `scene`."""
    return SceneNames(scene.graspable, scene.receptive, scene.version)


def scene_names_of_spec(spec: SceneSpec) -> SceneNames:
    """The names that a contract may use in a scene that is not running."""
    containers = tuple(thing.name for thing in spec.objects if thing.role == "container")
    graspable = tuple(thing.name for thing in spec.objects if thing.role == "object")
    return SceneNames(graspable, (*containers, *(place.name for place in spec.places)))
