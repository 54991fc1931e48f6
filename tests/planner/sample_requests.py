"""Requests, scenes and retrieved memories for tests of the planners."""

from typing import Any

from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.schema import decoding_schema, describe_skills
from dualbrain.contracts.skill_spec import ChoiceParameter, NameParameter, NumberParameter, SkillSpec, TextParameter
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Exemplar, RetrievedContext

NAMES = SceneNames(("red_cube", "green_cylinder"), ("blue_bowl", "table_left"))
SCENE = """robot panda; holding nothing
red_cube: object, neighbour_on_finger_axis none, neighbour_across low <3cm, near_edge no
blue_bowl: container
path red_cube -> blue_bowl: path_max_height tall, path_blocked_direct yes, overhead none
person: crossing
places: table_left"""

SPEED = NumberParameter(
    name="speed",
    unit="m/s",
    lower=0.05,
    upper=0.4,
    lower_from="site policy",
    upper_from="site policy",
    description="tool speed on the way",
)
REGISTRY = SkillRegistry(
    "panda",
    (
        SkillSpec("grasp", "take an object", (NameParameter("object", "graspable"), SPEED)),
        SkillSpec(
            "place",
            "put it there",
            (NameParameter("destination", "receptive"), SPEED, ChoiceParameter("wait", ("none", "clear"))),
        ),
        SkillSpec("decline", "refuse", (TextParameter("reason", 40, "why not"),)),
    ),
)
"""A registry with few skills, so that answers of the small model stay short."""


def plan_request(instruction: str = "put the red cube in the bowl", **changed: Any) -> PlanRequest:
    """A request about the scene above."""
    fields: dict[str, Any] = {
        "instruction": instruction,
        "scene": SCENE,
        "recall": RetrievedContext(),
        "robot": REGISTRY.robot,
        "registry_hash": REGISTRY.hash,
        "skills_text": describe_skills(REGISTRY, NAMES),
        "schema": decoding_schema(REGISTRY, NAMES),
        "contract_id": "c-0007",
    }
    return PlanRequest(**(fields | changed))


def exemplar(instruction: str = "fetch the tin", rank: int = 1, **changed: Any) -> Exemplar:
    """A retrieved memory."""
    fields: dict[str, Any] = {
        "episode_id": f"e-{rank}",
        "instruction": instruction,
        "summary": "robot panda; holding nothing",
        "contract": {
            "id": "c-0001",
            "action_sequence": [{"skill": "grasp", "params": {"object": "tin", "speed": 0.1}}],
        },
        "succeeded": True,
        "Delta": 0.01,
        "similarity": 0.9,
        "weight": 0.5,
        "score": 0.8,
        "rank": rank,
    }
    return Exemplar(**(fields | changed))
