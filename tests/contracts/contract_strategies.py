"""An arm's vocabulary as the design gives it, a scene, and strategies for contracts that follow from the specs."""

import json
from typing import Any

from hypothesis import strategies as st

from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import Registry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.skill_spec import Choice, ContactPermit, Name, Number, Parameter, SkillSpec, Text
from dualbrain.core.text import hides_something

PRINCIPAL = "planner"
NAMES = SceneNames(("red_cube", "blue_cube", "tall_cup"), ("bowl", "left_spot"))

SPEED = Number("speed", "m/s", 0.05, 0.4, "site policy", "site policy", "speed of the tool")
CLEARANCE = Number("clearance", "m", 0.03, 0.35, "site policy", "reach of the arm", "least height while carrying")
OPENING = Number("opening", "m", 0.005, 0.04, "site policy", "gripper data sheet", "opening of each finger")
FORCE = Number("force", "N", 1.0, 70.0, "site policy", "gripper data sheet", "grip force")
ANGLE = Number("angle", "rad", -1.57, 1.57, "reach of the wrist", "reach of the wrist", "angle about the tool's z")
FINGERS = Choice("finger_axis", ("along", "across"), "finger axis in the frame of the target")
APPROACH = Choice("approach", ("top", "side", "tilted"))
ROUTE = Choice("route", ("direct", "near_base", "left", "right"))
WAIT = Choice("wait", ("none", "until_clear"))
REASON = Text("reason", 160, "why nothing is done")


def build_registry(robot: str = "panda") -> Registry:
    """The seven skills of an arm in the design, and one with an angle."""
    permit = ContactPermit("close", "fingers", "target", 0.05)
    grasp = (Name("object", "graspable"), FORCE, SPEED, FINGERS, OPENING, APPROACH, ROUTE, WAIT)
    return Registry(
        robot,
        (
            SkillSpec("move_to", "go above a thing", (Name("target", "any"), SPEED, CLEARANCE, ROUTE, WAIT)),
            SkillSpec("grasp", "take a thing", grasp, (permit,)),
            SkillSpec("place", "put it there", (Name("destination", "receptive"), SPEED, CLEARANCE, ROUTE, WAIT)),
            SkillSpec("release", "open the fingers", (OPENING,)),
            SkillSpec("hold", "stand still", (Number("duration", "s", 0.1, 10.0, "site policy", "site policy"),)),
            SkillSpec("home", "go home", (SPEED,)),
            SkillSpec("turn_wrist", "turn about the approach", (ANGLE,)),
            SkillSpec("decline", "do nothing and say why", (REASON,)),
        ),
    )


REGISTRY = build_registry()


def unrestricted(registry: Registry = REGISTRY) -> Gate:
    """A gate that grants every skill and has no rules."""
    return Gate(registry, {PRINCIPAL: frozenset(registry.by_name)})


def check(gate: Gate, document: Any, names: SceneNames = NAMES) -> Any:
    """The gate's verdict on a document, written as JSON."""
    return gate.check(json.dumps(document).encode(), names=names, principal=PRINCIPAL, now=0.0)


def values(parameter: Parameter, names: SceneNames) -> st.SearchStrategy[Any]:
    """Every kind of value in the domain of `parameter`: whole numbers too."""
    match parameter:
        case Number():
            return numbers(parameter)
        case Choice():
            return st.sampled_from(parameter.choices)
        case Name():
            return st.sampled_from(names.offered(parameter.of))
        case Text():
            return st.text(max_size=20).filter(lambda text: not hides_something(text)) | st.just(
                "x" * parameter.max_length
            )


def numbers(number: Number) -> st.SearchStrategy[float]:
    """Floats and whole numbers within the bounds, both bounds often."""
    edges = st.sampled_from([number.lower, number.upper])
    floats = st.floats(number.lower, number.upper, allow_nan=False)
    whole = [n for n in range(int(number.lower), int(number.upper) + 1) if number.lower <= n <= number.upper]
    return st.one_of(edges, floats, st.sampled_from(whole)) if whole else st.one_of(edges, floats)


def contracts(registry: Registry = REGISTRY, names: SceneNames = NAMES) -> st.SearchStrategy[dict[str, Any]]:
    """Contracts that follow from the specs of `registry` in the scene `names`."""
    able = [s for s in registry.skills if all(names.offered(p.of) for p in s.parameters if isinstance(p, Name))]
    step = st.sampled_from(able).flatmap(
        lambda skill: st.fixed_dictionaries(
            {
                "skill": st.just(skill.name),
                "params": st.fixed_dictionaries({p.name: values(p, names) for p in skill.parameters}),
            }
        )
    )
    return st.fixed_dictionaries(
        {
            "id": st.integers(0, 9999).map("c-{:04d}".format),
            "context": st.fixed_dictionaries({"robot": st.just(registry.robot), "registry": st.just(registry.hash)}),
            "action_sequence": st.lists(step, min_size=1, max_size=8),
        }
    )
