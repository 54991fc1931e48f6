"""Scenes of synthetic examples: generated scenes, as the robot perceives them at the start of an episode.

Nothing is executed: a contract becomes an example if the gate accepts it in its scene.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np

from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.synthetic.example import EXEMPLAR_SHARE, SceneContext, generate_example
from dualbrain.adaptation.synthetic.split import (
    ROOM_FAMILIES,
    SCENE_SEEDS,
    TABLE_FAMILIES,
    TEMPLATES_HASH,
    Split,
    is_scene_allowed,
)
from dualbrain.adaptation.synthetic.templates import Phrasings, load_templates, template_sentences
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Accepted
from dualbrain.errors import ChecksumError
from dualbrain.grounding.envelope.scene_rules import scene_rules
from dualbrain.grounding.offline_gate import controller_at_home
from dualbrain.grounding.scene_summary import summarise_scene
from dualbrain.grounding.vocabulary import load_skill_registry, planner_grants, scene_names
from dualbrain.records import Scene
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.catalogue import is_mobile
from dualbrain.simulation.scenes.generators.rooms import make_room
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.instructions import (
    find_task_kind,
    instruction_templates,
    natural_name,
    task_kinds,
    templates_hash,
)

ROBOT_SHARES = {"panda": 0.6, "ur5e": 0.2, "base": 0.2}
"""Robots of the training examples, and their shares."""
MAX_TRAINING_CHARACTERS = 2200
"""Longest prompt and contract of a training example [characters]; a lower limit excludes most with two goals."""


def generate_examples(
    count: int,
    part: Split,
    seed: int = 0,
    robot_shares: Mapping[str, float] = ROBOT_SHARES,
    *,
    exemplar_share: float = EXEMPLAR_SHARE,
) -> tuple[Sample, ...]:
    """`count` examples of `part`, without duplicate prompts; the same arguments give the same examples.

    `robot_shares` are the shares of the robots, `exemplar_share` is the share of examples with exemplars in the prompt.
    """
    rng = np.random.default_rng([seed, *part.encode()])
    examples: dict[str, Sample] = {}
    names, shares = list(robot_shares), np.array(list(robot_shares.values()))
    while len(examples) < count:
        robot = str(rng.choice(names, p=shares / shares.sum()))
        spec = draw_scene(robot, part, rng)
        one = generate_example(
            make_scene_context(spec),
            load_templates(),
            load_phrasings(is_mobile(robot), part),
            rng,
            exemplar_share=exemplar_share,
        )
        if one is not None and (part == "test" or n_characters(one) <= MAX_TRAINING_CHARACTERS):
            examples.setdefault(str(one.prompt[-1]), one)
    return tuple(examples.values())


def n_characters(sample: Sample) -> int:
    """Number of characters of prompt and contract."""
    return len(sample.prompt[-1]["content"]) + len(sample.contract)


def draw_scene(robot: str, part: Split, rng: np.random.Generator) -> SceneSpec:
    """A scene for `robot` that `part` may use."""
    seeds, choice = SCENE_SEEDS[part], ROOM_FAMILIES if is_mobile(robot) else TABLE_FAMILIES
    while True:
        family, seed = choice[int(rng.integers(len(choice)))], int(rng.integers(seeds.start, seeds.stop))
        spec = (make_room if is_mobile(robot) else make_scene)(family, seed, robot)
        if is_scene_allowed(part, family, frozenset(obj.category for obj in spec.objects)):
            return spec


def make_scene_context(spec: SceneSpec) -> SceneContext:
    """The scene as the robot perceives it at the start, with the gate in front of the robot."""
    robot_model, registry = load_robot(spec.robot), load_skill_registry(spec.robot)
    scene = perceive_scene(spec)
    names = scene_names(scene)
    gate = Gate(registry, planner_grants(registry), scene_rules(scene, controller_at_home(spec.robot, scene)))

    def accepts(data: bytes) -> bool:
        return isinstance(gate.check(data, names=names, principal=PLANNER, now=0.0), Accepted)

    name = f"{spec.robot} {spec.family}:{spec.seed}"
    return SceneContext(
        registry=registry,
        scene=name,
        perceived=scene,
        summary=summarise_scene(scene),
        summary_with_values=summarise_scene(scene, values=True),
        names=names,
        mobile=robot_model.is_mobile,
        accepts=accepts,
    )


def perceive_scene(spec: SceneSpec) -> Scene:
    """The scene as the robot perceives it at the start, with the declared noise drawn from the seed of `spec`."""
    perception = NoisyPerception(spec, PerceptionNoise(), np.random.default_rng(spec.seed))
    return perception.perceive(make_plant(spec, load_robot(spec.robot), visuals=False))


@cache
def load_phrasings(mobile: bool, part: Split) -> Phrasings:
    """Phrasings of instructions for a mobile robot or an arm; raises `ChecksumError` if the templates changed.

    A held-out phrasing that also occurs in the training examples is excluded.
    """
    if (got := templates_hash()) != TEMPLATES_HASH:
        raise ChecksumError("wordings", got=got, expected=TEMPLATES_HASH, path="instructions.toml")
    names = [name for name in task_kinds(mobile=mobile) if name in load_templates().kinds]
    templates = {name: instruction_templates(name, "held_out" if part == "test" else "train") for name in names}
    robot_kind = "base" if mobile else "arm"
    sentences, trained = template_sentences(robot_kind, part, names), template_sentences(robot_kind, "teach", names)
    for name, phrasings in templates.items():
        texts = (one.text for one in phrasings if part != "test" or one.text not in trained[name])
        sentences[name] = (*texts, *sentences[name])
    return Phrasings(sentences, {name: find_task_kind(name).label for name in names}, natural_name)


@cache
def scene_context_by_name(scene: str) -> SceneContext:
    """The scene context with the name `scene`, such as "panda tall:20007"."""
    return make_scene_context(scene_by_name(scene))


def scene_by_name(scene: str) -> SceneSpec:
    """The simulated scene with the name `scene`, such as "panda tall:20007"."""
    robot, _, choice = scene.partition(" ")
    family, _, seed = choice.partition(":")
    return (make_room if is_mobile(robot) else make_scene)(family, int(seed), robot)
