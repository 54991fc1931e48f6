"""Success of a task to place an object, judged on simulator ground truth; for evaluation only.

Success: the object is placed, released, at rest, and upright if the goal demands it. Progress in [0, 1] counts the
stages so far in quarters: reached, grasped, lifted, placed.
"""

from __future__ import annotations

import re

import msgspec
import numpy as np

from dualbrain.core.geometry.shapes import Bowl, Cylinder, Vector
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.simulation.monitoring.contact_rules import ContactRules
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import ObjectSpec, SceneSpec
from dualbrain.simulation.scenes.supports import support_height
from dualbrain.simulation.tasks.arrival import ArrivalGoal
from dualbrain.skills.kinematics.object_geometry import lowest_height

PLACE_TOLERANCE = 0.05  # [m] in the plane
REACH_DISTANCE = 0.05  # [m] between tool and object
LIFT_HEIGHT = 0.03  # [m] of the lowest point above the surface below it
HEIGHT_TOLERANCE = (-0.01, 0.02)
"""Range of the lowest point [m] of an object above the surface that supports it."""
MAX_STATIC_SPEED, MAX_STATIC_TURN_RATE = 0.02, 0.5  # [m/s], [rad/s]
MAX_TILT = float(np.deg2rad(15.0))


class PlacementGoal(msgspec.Struct, frozen=True):
    """The object `object_name` is in or on `destination`, `upright` if demanded.

    With `gentle`, success also requires that the object was neither squeezed above its limit nor tilted nor shaken
    (`monitoring/handling.py`).
    """

    object_name: str
    destination: str
    upright: bool = False
    gentle: bool = False


def parse_goal(instruction: str, spec: SceneSpec) -> PlacementGoal | ArrivalGoal:
    """The goal of an instruction "put X in Y", or in a room "go to Y"; names with underscores or spaces.

    A cylinder that is put on a place must stay upright. Raises `ConfigurationError` for another sentence and
    `UnknownNameError` for names that are not in the scene.
    """
    graspable = tuple(item.name for item in spec.objects if item.role == "object")
    if spec.region and not (graspable and re.match(r"(?:put|place|move) ", instruction.strip().lower())):
        return _parse_arrival_goal(instruction, spec)
    match = re.fullmatch(
        r"(?:put|place|move) (?:the )?(.+?) (?:in|into|on|onto|to|at) (?:the )?(.+?)\.?",
        " ".join(instruction.split()).lower(),
        flags=re.DOTALL,
    )
    if match is None:
        raise ConfigurationError(
            "goal", got=instruction, allowed='"put THING in DESTINATION" (also place, move; into, on, onto, to, at)'
        )
    object_name, destination = (part.strip().replace(" ", "_") for part in match.groups())
    places = tuple(place.name for place in spec.places)
    receptive = tuple(item.name for item in spec.objects if item.role == "container") + places
    for kind, name, known in (("object", object_name, graspable), ("destination", destination, receptive)):
        if name not in known:
            raise UnknownNameError(kind, name, known, owner=f"scene {spec.family}")
    upright = destination in places and isinstance(spec.find(object_name).shape, Cylinder)
    return PlacementGoal(object_name, destination, upright=upright)


def _parse_arrival_goal(instruction: str, spec: SceneSpec) -> ArrivalGoal:
    match = re.fullmatch(r"(?:go|drive|bring yourself) to (?:the )?(.+?)\.?", instruction.strip().lower())
    if match is None:
        raise ConfigurationError("goal", got=instruction, allowed='"go to PLACE" (also drive to, bring yourself to)')
    place, known = match.group(1).strip().replace(" ", "_"), tuple(place.name for place in spec.places)
    if place not in known:
        raise UnknownNameError("place", place, known, owner=f"scene {spec.family}")
    return ArrivalGoal(place)


class PlacementJudge:
    """Judges one `PlacementGoal` during an episode: call `update` regularly (every 50 ms is enough), then `score`."""

    def __init__(self, plant: Plant, goal: PlacementGoal) -> None:
        """Judge `goal` in `plant`; raises `UnknownNameError`."""
        self._plant, self.goal = plant, goal
        plant.spec.find(goal.object_name)
        self._rules = ContactRules(plant.model, plant.spec)
        self._stages = np.zeros(3, bool)

    def update(self) -> None:
        """Record the stages so far: reached, grasped, lifted."""
        plant = self._plant
        tool, _ = plant.tool_pose()
        position = np.array(plant.true_pose(self.goal.object_name).position)
        grasped = count_touching_fingers(plant, self._rules, self.goal.object_name) == 2
        self._stages |= [
            np.linalg.norm(tool - position) < REACH_DISTANCE,
            grasped,
            grasped and _height_above_support(plant, self.goal.object_name) > LIFT_HEIGHT,
        ]

    def score(self) -> tuple[bool, float]:
        """Success, and progress in [0, 1]."""
        self.update()
        success, _ = score_placement(self._plant, self._plant.spec, self.goal)
        if success:
            return True, 1.0
        reached = int(np.maximum.accumulate(self._stages[::-1]).sum())
        return False, min(0.25 * (reached + int(is_placed(self._plant, self.goal))), 0.99)


def score_placement(plant: Plant, spec: SceneSpec, goal: PlacementGoal) -> tuple[bool, float]:
    """Success and progress from the present state alone: success 1, placed or lifted 0.75, grasped 0.5, near 0.25."""
    rules, obj = ContactRules(plant.model, spec), spec.find(goal.object_name)
    touching = count_touching_fingers(plant, rules, goal.object_name)
    placed = is_placed(plant, goal)
    if (
        placed
        and touching == 0
        and is_static(plant, goal.object_name)
        and (not goal.upright or _is_upright(plant, obj))
    ):
        return True, 1.0
    tool, _ = plant.tool_pose()
    position = np.array(plant.true_pose(goal.object_name).position)
    if touching == 2:
        return False, 0.75 if _height_above_support(plant, goal.object_name) > LIFT_HEIGHT else 0.5
    if placed:
        return False, 0.75
    return False, 0.25 if np.linalg.norm(tool - position) < REACH_DISTANCE else 0.0


def is_placed(plant: Plant, goal: PlacementGoal) -> bool:
    """Whether the object is inside the container, or on a support within 5 cm of the place.

    The container must be on a support. Nothing is placed on the floor: the places of a room are for the base.
    """
    pose = plant.true_pose(goal.object_name)
    at, obj, spec = pose.position, plant.spec.find(goal.object_name), plant.spec
    containers = {item.name: item for item in spec.objects if isinstance(item.shape, Bowl)}
    if goal.destination in containers:
        bowl_at = plant.true_pose(goal.destination).position
        inside = is_inside_bowl(at, bowl_at, containers[goal.destination].shape, lowest=lowest_height(obj.shape, pose))
        return inside and _is_on_support(plant, goal.destination)
    spot = spec.find_place(goal.destination).position
    near = np.hypot(at[0] - spot[0], at[1] - spot[1]) < PLACE_TOLERANCE
    return bool(near) and _is_on_support(plant, goal.object_name)


def _is_on_support(plant: Plant, name: str) -> bool:
    return HEIGHT_TOLERANCE[0] < _height_above_support(plant, name) < HEIGHT_TOLERANCE[1]


def _height_above_support(plant: Plant, name: str) -> float:
    """Height [m] of the lowest point of the object above the surface below it; infinite over the floor."""
    pose = plant.true_pose(name)
    height = support_height(plant.spec, *pose.position[:2])
    return np.inf if height is None else lowest_height(plant.spec.find(name).shape, pose) - height


def is_inside_bowl(at: Vector, bowl_at: Vector, bowl: object, *, lowest: float | None = None) -> bool:
    """Whether an object with its centre at `at` is in a bowl with its bottom at `bowl_at` [m].

    An object taller than the bowl is inside if its lowest point, at the height `lowest` [m], is in the lower half of
    the bowl.
    """
    assert isinstance(bowl, Bowl)
    radial = float(np.hypot(at[0] - bowl_at[0], at[1] - bowl_at[1]))
    height = at[2] - bowl_at[2]
    low = lowest is not None and lowest - bowl_at[2] < 0.5 * bowl.height
    return radial < bowl.radius - bowl.wall and height > 0.0 and (height < bowl.height + 0.01 or low)


def count_touching_fingers(plant: Plant, rules: ContactRules, name: str) -> int:
    """Number of fingers in contact with the object."""
    fingers = set()
    for first, second in plant.data.contact.geom.tolist():
        for one, other in ((first, second), (second, first)):
            if rules.owners[one] == name and rules.finger_mask[other]:
                fingers.add(rules.owners[other])
    return len(fingers)


def is_static(plant: Plant, name: str) -> bool:
    """Whether the object is at rest."""
    body = plant.data.body(name)
    turn, speed = np.linalg.norm(body.cvel[:3]), np.linalg.norm(plant.object_velocity(name))
    return bool(speed < MAX_STATIC_SPEED and turn < MAX_STATIC_TURN_RATE)


def _is_upright(plant: Plant, obj: ObjectSpec) -> bool:
    _, x, y, _ = plant.true_pose(obj.name).quaternion
    return float(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))) < MAX_TILT
