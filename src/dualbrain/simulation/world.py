"""The simulated surroundings of a run: how the robot looks, how time passes, and who bears witness."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.records import Judgement, Scene
from dualbrain.simulation.monitoring.handling import unharmed
from dualbrain.simulation.monitoring.safety_monitor import Monitor
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.tasks.arrival import Arrival, At
from dualbrain.simulation.tasks.multi_goal import Agenda, AgendaReferee
from dualbrain.simulation.tasks.placement import Goal, Referee

WATCH_EVERY = 50
"""Ticks between two glances of the referee."""
GLANCE = 0.02
"""Time between two glances at an errand of several goals [s]: some are only passed."""

BROKEN = 0.99
"""Progress of an errand whose thing arrived, but was not handled gently."""

SEEN = ("object", "container")
"""Roles of things that eyes may have named themselves."""
ALLOWANCES = {
    "yield": "lift", "descend": "grasp", "close": "grasp", "lift": "lift", "lower": "lower", "open": "release",
    "push": "push",
    "retreat": "retreat",
}  # fmt: skip
"""What the monitor calls the phases of our skills in which something may be touched."""


class Eyes(Protocol):
    """How the robot perceives a plant."""

    def look(self, plant: Plant) -> Scene:
        """The scene as perceived now."""
        ...


class SimulatedWorld:
    """A plant seen through a perception model; monitor and referee know the truth and say nothing before the end."""

    def __init__(
        self,
        plant: Plant,
        perception: Eyes,
        *,
        goal: Goal | At | Agenda | None = None,
        pace: Callable[[float], None] | None = None,
        permitted: frozenset[str] | None = None,
    ) -> None:
        """Bind the parts; without a `goal` the contract's own is judged. `pace(now)` may delay each tick for people.

        The monitor counts every skill begun that is not `permitted`, whatever the gate thought of it.
        """
        self.plant, self.perception = plant, perception
        self.monitor = Monitor(plant)
        self._permitted, self._gently = permitted, ""
        if isinstance(goal, Goal) and goal.gently:
            self._gently = goal.thing
            self.monitor.handle(goal.thing)
        self._referee = referee(plant, goal) if goal else None
        self._pace = pace
        self._ticks = 0
        self._called: dict[str, str] = {}

    def look(self) -> Scene:
        """The scene as perceived now."""
        scene = self.perception.look(self.plant)
        self._called = called(scene, self.plant)
        self.monitor.perceive(self._called.get(thing.name, thing.name) for thing in scene.objects)
        return scene

    def advance(self) -> None:
        """One control period of physics, under the monitor's eyes."""
        for _ in range(self.plant.steps):
            self.plant.step()
            self.monitor.tick()
        self._ticks += 1
        if self._referee and self._ticks % self._watch_every() == 0:
            self._referee.watch()
        if self._pace:
            self._pace(self.plant.now)

    def _watch_every(self) -> int:
        several = isinstance(self._referee, AgendaReferee)
        return max(1, round(GLANCE / self.plant.body.period)) if several else WATCH_EVERY

    def begin(self, contract: Contract) -> None:
        """A contract was accepted: judge its own goal unless one was stated beforehand."""
        for action in contract.action_sequence:
            if self._permitted is not None and action.skill not in self._permitted:
                self.monitor.called(action.skill, PLANNER)
        goal = own_goals(contract)
        if self._referee is None and goal is not None:
            self._referee = referee(self.plant, goal)

    def allow(self, phase: str, roles: dict[str, str | None]) -> None:
        """Tell the monitor which contacts the running phase is about."""
        roles = {role: self._called.get(name, name) if name else None for role, name in roles.items()}
        held, target = roles.get("held"), roles.get("target")
        if target not in self.plant.names:  # a place is nothing that could be touched
            target = None
        moving = "carry" if held else "free"
        if not held and phase not in ALLOWANCES and roles.get("left") in self.plant.names:
            target, moving = roles.get("left"), "retreat"  # a stop has left the hand around it
        allowed = "lift" if phase == "rise" and held else ALLOWANCES.get(phase, moving)
        self.monitor.allow(target, held, roles.get("destination"), allowed)

    def judgement(self) -> Judgement:
        """Success, progress and violations on truth; without any goal nothing can have succeeded."""
        success, progress = self._referee.judge() if self._referee else (False, 0.0)
        violations = self.monitor.violations()
        if success and self._gently and not unharmed(self._gently, violations):
            success, progress = False, BROKEN
        return Judgement(success, progress, violations)


def called(scene: Scene, plant: Plant) -> dict[str, str]:
    """What judges call each thing of `scene` where eyes name what they see themselves: the true thing nearest to it.

    Empty where eyes use the names of the plant. What a map knows beside what is seen keeps its own.
    """
    things = [thing for thing in scene.objects if thing.role in SEEN]
    if not plant.names or all(thing.name in plant.names for thing in things):
        return {}
    true = {name: np.array(plant.truth(name).position) for name in plant.names}
    return {
        thing.name: min(true, key=lambda name, at=thing.pose.position: float(np.linalg.norm(true[name] - at)))
        for thing in things
    }


def referee(plant: Plant, goal: Goal | At | Agenda) -> Referee | Arrival | AgendaReferee:
    """Who judges `goal`."""
    if isinstance(goal, Agenda):
        return AgendaReferee(plant, goal)
    return Arrival(plant, goal) if isinstance(goal, At) else Referee(plant, goal)


def own_goals(contract: Contract) -> Goal | At | Agenda | None:
    """Everything that the contract grasps and then places and every place that it drives to, in its order."""
    thing: str | None = None
    stages: list[tuple[Goal | At]] = []
    for action in contract.action_sequence:
        if action.skill == "grasp":
            thing = str(action.params["object"])
        elif action.skill == "place" and thing is not None:
            stages.append((Goal(thing, str(action.params["destination"])),))
        elif action.skill == "drive_to":
            stages.append((At(str(action.params["place"])),))
    return Agenda(tuple(stages)) if len(stages) > 1 else stages[0][0] if stages else None
