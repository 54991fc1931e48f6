"""The vocabulary of a robot by name, and the names that a scene offers to contracts."""

from __future__ import annotations

from pathlib import Path

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.registry import Registry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.records import Scene
from dualbrain.robots.loader import load_body
from dualbrain.robots.site_config import read_site
from dualbrain.safety.integration.site import site_body
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.skills.registry import registry_of


def vocabulary(robot: str) -> Registry:
    """The registry of skills of `robot`; raises `UnknownName` with the known robots."""
    return registry_of(load_body(robot))


def vocabulary_at(robot: str, site: Path) -> Registry:
    """The registry of `robot` where the site file `site` holds; raises `UnknownName`, `SiteError`."""
    return registry_of(site_body(load_body(robot), read_site(site)))


def grants(registry: Registry) -> dict[str, frozenset[str]]:
    """Who may call what: the planner may call every registered skill."""
    return {PLANNER: frozenset(skill.name for skill in registry.skills)}


def scene_names(scene: Scene) -> SceneNames:
    """The names that a contract may use in `scene`."""
    return SceneNames(scene.graspable, scene.receptive, scene.version)


def spec_names(spec: SceneSpec) -> SceneNames:
    """The names that a contract may use in a scene that is not running."""
    containers = tuple(thing.name for thing in spec.things if thing.role == "container")
    graspable = tuple(thing.name for thing in spec.things if thing.role == "object")
    return SceneNames(graspable, (*containers, *(place.name for place in spec.places)))
