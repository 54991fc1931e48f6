"""Where lessons are given: scenes from the catalogue's generators, seen as the robot would see them at the start.

Nothing moves here: a contract is shown if the gate accepts it in that scene, whatever would become of it.
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
from dualbrain.grounding.offline_gate import controller_at_home
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.scene_summary import summarise_scene
from dualbrain.grounding.vocabulary import load_skill_registry, planner_grants, scene_names
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
"""Whose language is taught, and how often."""
MAX_TRAINING_CHARACTERS = 2200
"""Characters of question and answer that are taught: less would leave out most lessons with two goals."""


def generate_examples(
    count: int,
    part: Split,
    seed: int = 0,
    robot_shares: Mapping[str, float] = ROBOT_SHARES,
    *,
    exemplar_share: float = EXEMPLAR_SHARE,
) -> tuple[Sample, ...]:
    """`count` lessons of `part`, no question twice; the same arguments give the same lessons.

    `robots` says how often which robot is spoken to, `exemplars` how often some are shown.
    """
    rng = np.random.default_rng([seed, *part.encode()])
    found: dict[str, Sample] = {}
    names, shares = list(robot_shares), np.array(list(robot_shares.values()))
    while len(found) < count:
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
            found.setdefault(str(one.prompt[-1]), one)
    return tuple(found.values())


def n_characters(sample: Sample) -> int:
    """Characters of question and answer."""
    return len(sample.prompt[-1]["content"]) + len(sample.contract)


def draw_scene(robot: str, part: Split, rng: np.random.Generator) -> SceneSpec:
    """A scene for `robot` that `part` may use."""
    seeds, choice = SCENE_SEEDS[part], ROOM_FAMILIES if is_mobile(robot) else TABLE_FAMILIES
    while True:
        family, seed = choice[int(rng.integers(len(choice)))], int(rng.integers(seeds.start, seeds.stop))
        spec = (make_room if is_mobile(robot) else make_scene)(family, seed, robot)
        if is_scene_allowed(part, family, frozenset(thing.category for thing in spec.objects)):
            return spec


def make_scene_context(spec: SceneSpec) -> SceneContext:
    """The scene as it would be perceived at the start, with the gate that stands before the robot there."""
    robot_model, registry = load_robot(spec.robot), load_skill_registry(spec.robot)
    scene = NoisyPerception(spec, PerceptionNoise(), np.random.default_rng(spec.seed)).perceive(
        make_plant(spec, robot_model, visuals=False)
    )
    names = scene_names(scene)
    gate = Gate(registry, planner_grants(registry), scene_rules(scene, controller_at_home(spec.robot, scene)))

    def accepts(data: bytes) -> bool:
        return isinstance(gate.check(data, names=names, principal=PLANNER, now=0.0), Accepted)

    name = f"{spec.robot} {spec.family}:{spec.seed}"
    return SceneContext(
        registry=registry,
        scene=name,
        summary=summarise_scene(scene),
        names=names,
        mobile=robot_model.is_mobile,
        accepts=accepts,
    )


@cache
def load_phrasings(mobile: bool, part: Split) -> Phrasings:
    """How people talk to a robot that drives, or to an arm; raises `WrongHash` if the wordings are not as fixed.

    A held-out wording that a lesson happens to use as well tests nothing and is not asked.
    """
    if (got := templates_hash()) != TEMPLATES_HASH:
        raise ChecksumError("wordings", got=got, expected=TEMPLATES_HASH, path="instructions.toml")
    names = [name for name in task_kinds(mobile=mobile) if name in load_templates().kinds]
    found = {name: instruction_templates(name, "held_out" if part == "test" else "train") for name in names}
    sort = "base" if mobile else "arm"
    sentences, taught = template_sentences(sort, part, names), template_sentences(sort, "teach", names)
    for name, some in found.items():
        asked = (one.text for one in some if part != "test" or one.text not in taught[name])
        sentences[name] = (*asked, *sentences[name])
    return Phrasings(sentences, {name: find_task_kind(name).label for name in names}, natural_name)


@cache
def scene_context_by_name(scene: str) -> SceneContext:
    """The setting by its name, such as "panda tall:20007"."""
    robot, _, choice = scene.partition(" ")
    family, _, seed = choice.partition(":")
    return make_scene_context((make_room if is_mobile(robot) else make_scene)(family, int(seed), robot))
