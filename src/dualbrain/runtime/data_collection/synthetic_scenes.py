"""Where lessons are given: scenes from the catalogue's generators, seen as the robot would see them at the start.

Nothing moves here: a contract is shown if the gate accepts it in that scene, whatever would become of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np

from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.synthetic.example import SHOWN, Setting, lesson
from dualbrain.adaptation.synthetic.split import ROOMS, SEEDS, TABLES, WORDINGS, Part, may_stand
from dualbrain.adaptation.synthetic.templates import Speech, book, own_sentences
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Accepted
from dualbrain.errors import WrongHash
from dualbrain.grounding.offline_gate import limb_at_home
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.scene_summary import summarise
from dualbrain.grounding.vocabulary import grants, scene_names, vocabulary
from dualbrain.robots.loader import load_body
from dualbrain.simulation.perception.noisy_perception import Noise, Perception
from dualbrain.simulation.plant.factory import open_plant
from dualbrain.simulation.scenes.generators.catalogue import mobile
from dualbrain.simulation.scenes.generators.rooms import make_room
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.instructions import kind_of, kinds, spoken, wordings, wordings_hash

ROBOTS = {"panda": 0.6, "ur5e": 0.2, "base": 0.2}
"""Whose language is taught, and how often."""
LONGEST = 2200
"""Characters of question and answer that are taught: less would leave out most lessons with two goals."""


def lessons(
    count: int, part: Part, seed: int = 0, robots: Mapping[str, float] = ROBOTS, *, exemplars: float = SHOWN
) -> tuple[Sample, ...]:
    """`count` lessons of `part`, no question twice; the same arguments give the same lessons.

    `robots` says how often which robot is spoken to, `exemplars` how often some are shown.
    """
    rng = np.random.default_rng([seed, *part.encode()])
    found: dict[str, Sample] = {}
    names, shares = list(robots), np.array(list(robots.values()))
    while len(found) < count:
        robot = str(rng.choice(names, p=shares / shares.sum()))
        spec = draw_scene(robot, part, rng)
        one = lesson(setting(spec), book(), speech(mobile(robot), part), rng, exemplars=exemplars)
        if one is not None and (part == "test" or length(one) <= LONGEST):
            found.setdefault(str(one.prompt[-1]), one)
    return tuple(found.values())


def length(sample: Sample) -> int:
    """Characters of question and answer."""
    return len(sample.prompt[-1]["content"]) + len(sample.contract)


def draw_scene(robot: str, part: Part, rng: np.random.Generator) -> SceneSpec:
    """A scene for `robot` that `part` may use."""
    seeds, choice = SEEDS[part], ROOMS if mobile(robot) else TABLES
    while True:
        family, seed = choice[int(rng.integers(len(choice)))], int(rng.integers(seeds.start, seeds.stop))
        spec = (make_room if mobile(robot) else make_scene)(family, seed, robot)
        if may_stand(part, family, frozenset(thing.category for thing in spec.things)):
            return spec


def setting(spec: SceneSpec) -> Setting:
    """The scene as it would be perceived at the start, with the gate that stands before the robot there."""
    body, registry = load_body(spec.robot), vocabulary(spec.robot)
    scene = Perception(spec, Noise(), np.random.default_rng(spec.seed)).look(open_plant(spec, body, visuals=False))
    names = scene_names(scene)
    gate = Gate(registry, grants(registry), scene_rules(scene, limb_at_home(spec.robot, scene)))

    def accepts(data: bytes) -> bool:
        return isinstance(gate.check(data, names=names, principal=PLANNER, now=0.0), Accepted)

    name = f"{spec.robot} {spec.family}:{spec.seed}"
    return Setting(registry, name, summarise(scene), names, body.mobile, accepts)


@cache
def speech(drives: bool, part: Part) -> Speech:
    """How people talk to a robot that drives, or to an arm; raises `WrongHash` if the wordings are not as fixed.

    A held-out wording that a lesson happens to use as well tests nothing and is not asked.
    """
    if (got := wordings_hash()) != WORDINGS:
        raise WrongHash("wordings", got=got, expected=WORDINGS, path="instructions.toml")
    names = [name for name in kinds(mobile=drives) if name in book().kinds]
    found = {name: wordings(name, "held_out" if part == "test" else "train") for name in names}
    sort = "base" if drives else "arm"
    sentences, taught = own_sentences(sort, part, names), own_sentences(sort, "teach", names)
    for name, some in found.items():
        asked = (one.text for one in some if part != "test" or one.text not in taught[name])
        sentences[name] = (*asked, *sentences[name])
    return Speech(sentences, {name: kind_of(name).label for name in names}, spoken)


@cache
def setting_of(scene: str) -> Setting:
    """The setting by its name, such as "panda tall:20007"."""
    robot, _, choice = scene.partition(" ")
    family, _, seed = choice.partition(":")
    return setting((make_room if mobile(robot) else make_scene)(family, int(seed), robot))
