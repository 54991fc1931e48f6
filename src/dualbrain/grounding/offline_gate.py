"""Looking at a contract without a robot: the gate on a scene as it would be at the start of a run."""

from __future__ import annotations

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Verdict
from dualbrain.core.geometry.shapes import HalfSpace, Pose
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.vocabulary import grants, scene_names, vocabulary
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import at_home
from dualbrain.robots.loader import load_body
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec, closed_floor
from dualbrain.skills.arm.controller import Limb
from dualbrain.skills.mobile_base.controller import Chassis
from dualbrain.skills.mobile_manipulator import Carrier
from dualbrain.skills.registry import limb_of
from dualbrain.skills.skill import Senses


def check_contract(data: bytes, *, robot: str, scene: str) -> Verdict:
    """What the gate says of `data` for `robot` at home in front of `scene`, all three stages and the scene's rules."""
    registry = vocabulary(robot)
    seen = as_specified(open_scene(scene, robot))
    limb = limb_at_home(robot, seen)
    gate = Gate(registry, grants(registry), scene_rules(seen, limb))
    return gate.check(data, names=scene_names(seen), principal=PLANNER, now=0.0)


def limb_at_home(robot: str, scene: Scene) -> Limb | Chassis | Carrier:
    """An arm at its home posture, a base at its start, or both, that sees `scene`."""
    body = load_body(robot)
    safety = SafetyFilter(body)
    limb = limb_of(body, safety)
    state = at_home(body)
    limb.sense(Senses(state, scene, 0.0, safety.tool(state.q)))
    return limb


def as_specified(spec: SceneSpec) -> Scene:
    """The scene as its specification puts it: exact poses, nothing moving."""
    table = SceneObject("table", "support", HalfSpace(), Pose((0.0, 0.0, 0.0)))
    things = (
        SceneObject(
            thing.name, thing.role, thing.shape, Pose(thing.position, thing.quaternion), category=thing.category,
            colour=thing.colour, fragile_limit=thing.fragile_limit,
        )
        for thing in spec.things
    )  # fmt: skip
    support = () if spec.region else (table,)
    return Scene(spec.robot, 0.0, 1, (*support, *things, *closed_floor(spec, 0.0)), spec.places, spec.floor)
