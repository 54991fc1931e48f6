"""Skill registries by robot name, and the names in a scene that contracts may use."""

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
    """The skill registry of `robot`; raises `UnknownNameError` for an unknown robot."""
    return skill_registry(load_robot(robot))


def skill_registry_at_site(robot: str, site: Path) -> SkillRegistry:
    """The skill registry of `robot` with the limits of the site file `site`.

    Raises `UnknownNameError` for an unknown robot and `SiteError` for an invalid site file.
    """
    return skill_registry(site_robot(load_robot(robot), read_site(site)))


def planner_grants(registry: SkillRegistry) -> dict[str, frozenset[str]]:
    """The permitted skills by principal: the planner may use every skill of `registry`."""
    return {PLANNER: frozenset(skill.name for skill in registry.skills)}


def scene_names(scene: Scene) -> SceneNames:
    """The names that a contract may use in `scene`."""
    return SceneNames(scene.graspable, scene.receptive, scene.version)


def scene_names_of_spec(spec: SceneSpec) -> SceneNames:
    """The names that a contract may use in the scene `spec`, without a running plant."""
    containers = tuple(obj.name for obj in spec.objects if obj.role == "container")
    graspable = tuple(obj.name for obj in spec.objects if obj.role == "object")
    return SceneNames(graspable, (*containers, *(place.name for place in spec.places)))
