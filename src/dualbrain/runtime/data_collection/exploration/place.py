"""One place of the exploration: a generated scene as the robot perceives it, and one placement task in it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dualbrain.adaptation.curation.curate import CONTRACT_ID
from dualbrain.adaptation.synthetic.split import Split
from dualbrain.adaptation.value_model.symbols import Placement
from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.grounding.alternatives import SkillSteps, alternatives
from dualbrain.grounding.scene_summary import summarise_scene
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.records import Scene
from dualbrain.runtime.data_collection.synthetic_scenes import draw_scene, perceive_scene, scene_by_name
from dualbrain.simulation.scenes.scene_spec import SceneSpec


@dataclass(frozen=True)
class Place:
    """A scene with its name, such as "panda tall:50007", and the task `steps` in it."""

    scene_name: str
    steps: SkillSteps

    @cached_property
    def spec(self) -> SceneSpec:
        """The simulated scene."""
        return scene_by_name(self.scene_name)

    @cached_property
    def scene(self) -> Scene:
        """The scene as the robot perceives it at the start."""
        return perceive_scene(self.spec)

    @property
    def registry(self) -> SkillRegistry:
        """The skills of the robot."""
        return load_skill_registry(self.spec.robot)

    @property
    def summary(self) -> str:
        """The scene in symbols, with the values of fitting parameters."""
        return summarise_scene(self.scene, values=True)

    @property
    def placement(self) -> Placement:
        """The task as the value model reads it."""
        return Placement(self.summary, str(self.steps[0][1]["object"]), str(self.steps[-1][1]["destination"]))

    def contracts(self) -> dict[str, str]:
        """The canonical text of each alternative, by its name."""
        return {
            name: self.contract_text(actions)
            for name, actions in alternatives(self.registry, self.scene, self.steps).items()
        }

    def contract_text(self, actions: tuple[Action, ...]) -> str:
        """The canonical contract with `actions`."""
        context = Context(self.registry.robot, self.registry.hash)
        return canonical_contract(Contract(CONTRACT_ID, context, actions), self.registry)


def draw_place(robot: str, part: Split, rng: np.random.Generator) -> Place:
    """A random placement in a random scene of `part`: any object that can be grasped, to any destination."""
    spec = draw_scene(robot, part, rng)
    scene = perceive_scene(spec)
    obj, destination = str(rng.choice(scene.graspable)), str(rng.choice(scene.receptive))
    name = f"{spec.robot} {spec.family}:{spec.seed}"
    return Place(name, (("grasp", {"object": obj}), ("place", {"destination": destination})))
