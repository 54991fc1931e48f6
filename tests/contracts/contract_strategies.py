"""A skill registry of an arm, a scene, and hypothesis strategies for contracts that follow from the specifications."""

import json
from typing import Any

from hypothesis import strategies as st

from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.skill_spec import (
    ChoiceParameter,
    ContactPermit,
    NameParameter,
    NumberParameter,
    Parameter,
    SkillSpec,
    TextParameter,
)
from dualbrain.core.untrusted.hidden_characters import has_hidden_characters

PRINCIPAL = "planner"
NAMES = SceneNames(("red_cube", "blue_cube", "tall_cup"), ("bowl", "left_spot"))

SPEED = NumberParameter(
    name="speed",
    unit="m/s",
    lower=0.05,
    upper=0.4,
    lower_from="site policy",
    upper_from="site policy",
    description="speed of the tool",
)
CLEARANCE = NumberParameter(
    name="clearance",
    unit="m",
    lower=0.03,
    upper=0.35,
    lower_from="site policy",
    upper_from="reach of the arm",
    description="least height while carrying",
)
OPENING = NumberParameter(
    name="opening",
    unit="m",
    lower=0.005,
    upper=0.04,
    lower_from="site policy",
    upper_from="gripper data sheet",
    description="opening of each finger",
)
FORCE = NumberParameter(
    name="force",
    unit="N",
    lower=1.0,
    upper=70.0,
    lower_from="site policy",
    upper_from="gripper data sheet",
    description="grip force",
)
ANGLE = NumberParameter(
    name="angle",
    unit="rad",
    lower=-1.57,
    upper=1.57,
    lower_from="reach of the wrist",
    upper_from="reach of the wrist",
    description="angle about the tool's z",
)
FINGERS = ChoiceParameter("finger_axis", ("along", "across"), "finger axis in the frame of the target")
APPROACH = ChoiceParameter("approach", ("top", "side", "tilted"))
ROUTE = ChoiceParameter("route", ("direct", "near_base", "left", "right"))
WAIT = ChoiceParameter("wait", ("none", "until_clear"))
REASON = TextParameter("reason", 160, "why nothing is done")


def build_registry(robot: str = "panda") -> SkillRegistry:
    """The seven skills of an arm, and one skill with an angle."""
    permit = ContactPermit("close", "fingers", "target", 0.05)
    grasp = (NameParameter("object", "graspable"), FORCE, SPEED, FINGERS, OPENING, APPROACH, ROUTE, WAIT)
    return SkillRegistry(
        robot,
        (
            SkillSpec("move_to", "go above a thing", (NameParameter("target", "any"), SPEED, CLEARANCE, ROUTE, WAIT)),
            SkillSpec("grasp", "take a thing", grasp, (permit,)),
            SkillSpec(
                "place", "put it there", (NameParameter("destination", "receptive"), SPEED, CLEARANCE, ROUTE, WAIT)
            ),
            SkillSpec("release", "open the fingers", (OPENING,)),
            SkillSpec(
                "hold",
                "stand still",
                (
                    NumberParameter(
                        name="duration",
                        unit="s",
                        lower=0.1,
                        upper=10.0,
                        lower_from="site policy",
                        upper_from="site policy",
                    ),
                ),
            ),
            SkillSpec("home", "go home", (SPEED,)),
            SkillSpec("turn_wrist", "turn about the approach", (ANGLE,)),
            SkillSpec("decline", "do nothing and state why", (REASON,)),
        ),
    )


REGISTRY = build_registry()


def unrestricted_gate(registry: SkillRegistry = REGISTRY) -> Gate:
    """A gate that grants every skill and has no rules."""
    return Gate(registry, {PRINCIPAL: frozenset(registry.by_name)})


def check_document(gate: Gate, document: Any, names: SceneNames = NAMES) -> Any:
    """The gate's verdict on a document, written as JSON."""
    return gate.check(json.dumps(document).encode(), names=names, principal=PRINCIPAL, now=0.0)


def value_strategy(parameter: Parameter, names: SceneNames) -> st.SearchStrategy[Any]:
    """Every kind of value in the domain of `parameter`, also integers."""
    match parameter:
        case NumberParameter():
            return number_strategy(parameter)
        case ChoiceParameter():
            return st.sampled_from(parameter.choices)
        case NameParameter():
            return st.sampled_from(names.names_of_kind(parameter.of))
        case TextParameter():
            return st.text(max_size=20).filter(lambda text: not has_hidden_characters(text)) | st.just(
                "x" * parameter.max_length
            )


def number_strategy(number: NumberParameter) -> st.SearchStrategy[float]:
    """Floats and integers within the bounds; both bounds are drawn often."""
    bounds = st.sampled_from([number.lower, number.upper])
    floats = st.floats(number.lower, number.upper, allow_nan=False)
    integers = [n for n in range(int(number.lower), int(number.upper) + 1) if number.lower <= n <= number.upper]
    return st.one_of(bounds, floats, st.sampled_from(integers)) if integers else st.one_of(bounds, floats)


def contract_strategy(
    registry: SkillRegistry = REGISTRY, names: SceneNames = NAMES
) -> st.SearchStrategy[dict[str, Any]]:
    """Contracts that follow from the specifications of `registry` in the scene `names`."""
    callable_skills = [
        s
        for s in registry.skills
        if all(names.names_of_kind(p.of) for p in s.parameters if isinstance(p, NameParameter))
    ]
    step = st.sampled_from(callable_skills).flatmap(
        lambda skill: st.fixed_dictionaries(
            {
                "skill": st.just(skill.name),
                "params": st.fixed_dictionaries({p.name: value_strategy(p, names) for p in skill.parameters}),
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
