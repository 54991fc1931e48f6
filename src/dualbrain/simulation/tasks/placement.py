"""Did the errand succeed? Judged on simulator truth, for evaluation only.

Success = placed, released, static, and upright where the thing must stand. Progress in [0, 1] counts the stages
reached so far in quarters: reached, grasped, lifted, placed.
"""

from __future__ import annotations

import re

import msgspec
import numpy as np

from dualbrain.core.geometry.shapes import Bowl, Cylinder, Vector
from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.simulation.monitoring.contact_rules import ContactRules
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import SceneSpec, Thing
from dualbrain.simulation.tasks.arrival import At

NEAR_PLACE = 0.05  # [m] in the plane
REACHED = 0.05  # [m] from the tool to the thing
LIFTED = 0.03  # [m] above where it stood
STATIC_SPEED, STATIC_TURN = 0.02, 0.5  # [m/s], [rad/s]
TILT = float(np.deg2rad(15.0))


class Goal(msgspec.Struct, frozen=True):
    """Put `thing` in or on `destination`; `upright` when it must stand as it stood.

    `gently`: it counts only if the thing was neither squeezed above its limit nor tilted nor shaken (`handling`).
    """

    thing: str
    destination: str
    upright: bool = False
    gently: bool = False


def goal_of(words: str, spec: SceneSpec) -> Goal | At:
    """The goal that "put X in Y", or in a room "go to Y", states; underscores or spaces in names.

    Raises `InvalidSetup` for another sentence and `UnknownName` for names that the scene does not hold. A tall or
    fragile thing that goes onto a place must stay upright.
    """
    graspable = tuple(item.name for item in spec.things if item.role == "object")
    if spec.region and not (graspable and re.match(r"(?:put|place|move) ", words.strip().lower())):
        return _place_of(words, spec)
    match = re.fullmatch(
        r"(?:put|place|move) (?:the )?(.+?) (?:in|into|on|onto|to|at) (?:the )?(.+?)\.?", words.strip().lower()
    )
    if match is None:
        raise InvalidSetup(
            "goal", got=words, allowed='"put THING in DESTINATION" (also place, move; into, on, onto, to, at)'
        )
    thing, destination = (part.strip().replace(" ", "_") for part in match.groups())
    receptive = tuple(item.name for item in spec.things if item.role == "container") + tuple(
        p.name for p in spec.places
    )
    for name, known in ((thing, graspable), (destination, receptive)):
        if name not in known:
            raise UnknownName("thing" if name == thing else "destination", name, known, owner=f"scene {spec.family}")
    what = spec.find(thing)
    to_place = destination in {place.name for place in spec.places}
    return Goal(thing, destination, upright=to_place and isinstance(what.shape, Cylinder))


def _place_of(words: str, spec: SceneSpec) -> At:
    match = re.fullmatch(r"(?:go|drive|bring yourself) to (?:the )?(.+?)\.?", words.strip().lower())
    if match is None:
        raise InvalidSetup("goal", got=words, allowed='"go to PLACE" (also drive to, bring yourself to)')
    place, known = match.group(1).strip().replace(" ", "_"), tuple(place.name for place in spec.places)
    if place not in known:
        raise UnknownName("place", place, known, owner=f"scene {spec.family}")
    return At(place)


class Referee:
    """Follows one goal through an episode: call `watch` now and then (every 50 ms is enough), then `judge`."""

    def __init__(self, plant: Plant, goal: Goal) -> None:
        """Remember where the thing stood."""
        self._plant, self.goal = plant, goal
        self._thing = plant.spec.find(goal.thing)
        self._rules = ContactRules(plant.model, plant.spec)
        self._rest = plant.truth(goal.thing).position[2]
        self._stages = np.zeros(3, bool)

    def watch(self) -> None:
        """Note the stages reached by now: reached, grasped, lifted."""
        plant = self._plant
        tool, _ = plant.tool_pose()
        at = np.array(plant.truth(self.goal.thing).position)
        grasped = _touching(plant, self._rules, self.goal.thing) == 2
        self._stages |= [np.linalg.norm(tool - at) < REACHED, grasped, grasped and at[2] > self._rest + LIFTED]

    def judge(self) -> tuple[bool, float]:
        """(success, progress) as of now."""
        self.watch()
        success, _ = judge(self._plant, self._plant.spec, self.goal)
        if success:
            return True, 1.0
        reached = int(np.maximum.accumulate(self._stages[::-1]).sum())
        return False, min(0.25 * (reached + int(placed(self._plant, self.goal))), 0.99)


def judge(plant: Plant, spec: SceneSpec, goal: Goal) -> tuple[bool, float]:
    """(success, progress) from the present state alone: success 1, placed or lifted 0.75, grasped 0.5, near 0.25."""
    rules, thing = ContactRules(plant.model, spec), spec.find(goal.thing)
    touching = _touching(plant, rules, goal.thing)
    there = placed(plant, goal)
    if there and touching == 0 and _static(plant, goal.thing) and (not goal.upright or _upright(plant, thing)):
        return True, 1.0
    tool, _ = plant.tool_pose()
    at = np.array(plant.truth(goal.thing).position)
    if touching == 2:
        return False, 0.75 if at[2] > thing.position[2] + LIFTED else 0.5
    if there:
        return False, 0.75
    return False, 0.25 if np.linalg.norm(tool - at) < REACHED else 0.0


def placed(plant: Plant, goal: Goal) -> bool:
    """Whether the thing is inside the container, or within 5 cm of the place and on the table."""
    at = plant.truth(goal.thing).position
    thing, spec = plant.spec.find(goal.thing), plant.spec
    containers = {item.name: item for item in spec.things if isinstance(item.shape, Bowl)}
    if goal.destination in containers:
        return inside(at, plant.truth(goal.destination).position, containers[goal.destination].shape)
    spot = spec.place(goal.destination).position
    on_table = at[2] < thing.position[2] + 0.02
    return bool(np.hypot(at[0] - spot[0], at[1] - spot[1]) < NEAR_PLACE and at[2] > 0.0 and on_table)


def inside(at: Vector, bowl_at: Vector, bowl: object) -> bool:
    """Whether a thing whose middle is `at` lies in a bowl whose bottom is at `bowl_at` [m]."""
    assert isinstance(bowl, Bowl)
    radial = float(np.hypot(at[0] - bowl_at[0], at[1] - bowl_at[1]))
    return radial < bowl.radius - bowl.wall and 0.0 < at[2] - bowl_at[2] < bowl.height + 0.01


def _touching(plant: Plant, rules: ContactRules, name: str) -> int:
    """How many fingers touch the thing."""
    fingers = set()
    for first, second in plant.data.contact.geom.tolist():
        for one, other in ((first, second), (second, first)):
            if rules.owner[one] == name and rules.fingers[other]:
                fingers.add(rules.owner[other])
    return len(fingers)


def _static(plant: Plant, name: str) -> bool:
    body = plant.data.body(name)
    turn, speed = np.linalg.norm(body.cvel[:3]), np.linalg.norm(plant.velocity(name))
    return bool(speed < STATIC_SPEED and turn < STATIC_TURN)


def _upright(plant: Plant, thing: Thing) -> bool:
    _, x, y, _ = plant.truth(thing.name).quaternion
    return float(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0))) < TILT
