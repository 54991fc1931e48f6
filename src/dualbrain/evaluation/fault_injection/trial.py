"""One injected episode in lockstep: an errand that breaks at its moment, judged by the independent monitor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import LocalLayer
from dualbrain.control.control_loop import LayerConfig
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.evaluation.fault_injection.faults import (
    Fault,
    FaultyRobot,
    FaultyWorld,
    Injector,
    break_filter,
    faulty_clock,
)
from dualbrain.evaluation.fault_injection.gatekeeper_trial import attend
from dualbrain.records import Violation
from dualbrain.robots.loader import load_body
from dualbrain.robots.model import Body
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.supervisor.actions import Rung
from dualbrain.simulation.perception.noisy_perception import Noise, Perception
from dualbrain.simulation.plant.factory import open_plant
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.world import SimulatedWorld

GRASP = {
    "object": "red_cube", "speed": 0.35, "clearance": 0.15, "finger_axis": "along", "opening": 0.08,
    "approach": "top", "wait": "none", "force": 20.0,
}  # fmt: skip
PLACE = {"destination": "blue_bowl", "speed": 0.35, "clearance": 0.15, "route": "direct", "wait": "none"}
DRIVE = {"place": "shelf", "max_speed": 0.6, "max_turn_rate": 1.0}
UNSAFE = ("collision_env", "collision_human", "self_collision", "collision_held", "joint_limit", "joint_velocity")
"""Kinds of violation that a fault must not lead to; others (a load that was let go) are listed."""
AT_REST = 0.02
"""An arm whose joints are slower than this [rad/s] is touched; it does not touch."""
AT_THE_DOOR = ("planner", "socket")
"""Sources beyond the gatekeeper's door."""
SETTLE, AFTERMATH = 1.0, 0.5
"""How long the local layer goes on after the contract, and the world after that [s]."""


class FaultReport(msgspec.Struct, frozen=True):
    """What a fault led to. Times in s; `reaction` from the strike to the first order that was expected or stronger.

    `rest` from the strike until the arm was at rest. `unsafe` are the violations that count, each with the arm moving.
    """

    fault: str
    scene: str
    struck: float | None
    expected: str
    reached: str
    checks: tuple[str, ...]
    reaction: float | None
    rest: float | None
    outcome: str
    reason: str
    unsafe: tuple[Violation, ...]
    other: tuple[Violation, ...]

    @property
    def safe(self) -> bool:
        """Nothing unsafe happened."""
        return not self.unsafe

    @property
    def as_declared(self) -> bool:
        """The order that was expected came, or a stronger one; a fault whose moment never came proves nothing."""
        return self.struck is None or Rung[self.reached] >= Rung[self.expected]


def inject(fault: Fault, *, robot: str = "panda", scene: str = "tabletop:1", seed: int = 0) -> FaultReport:
    """Carry out a pick and place of the red cube (or a drive to the shelf) that breaks by `fault`.

    Nothing of it reaches a memory.
    """
    body, spec = load_body(robot), open_scene(scene, robot)
    if fault.source in AT_THE_DOOR:
        return _at_the_door(fault, body, spec, scene, seed)
    plant = open_plant(spec, body)
    world = SimulatedWorld(plant, Perception(spec, Noise(), np.random.default_rng([seed, 1])))
    injector = Injector(fault, lambda: plant.now)
    safety = SafetyFilter(body)
    break_filter(safety, injector)

    def phase_changed(phase: str, roles: dict[str, str | None]) -> None:
        world.allow(phase, roles)
        injector.phase(phase)

    told: list[tuple[float, Event]] = []  # with true times: the robot's own stamps may be what is broken
    log = FlightLog(Trace(body.n, body.width), None, lambda event: told.append((plant.now, event)))
    layer = LocalLayer(
        body, FaultyRobot(plant, injector, body), FaultyWorld(world, injector), safety, log, LayerConfig(settle=SETTLE),
        phase_changed=phase_changed, clock=faulty_clock(lambda: plant.now, injector),
    )  # fmt: skip
    contract = Contract("c-0001", Context(robot, ""), tuple(Action(*one) for one in errand(body)))
    watched = _Watched(plant)
    setattr(world, "advance", watched.after(world.advance))  # noqa: B010  (an observer of truth, for this one world)
    outcome = layer.run(contract)
    for _ in range(round(AFTERMATH / body.period)):  # the world goes on, whatever has ended
        world.advance()
    struck = injector.struck
    violations = world.judgement().violations
    unsafe = tuple(one for one in violations if one.kind in UNSAFE and watched.moved_at(one.start))
    expected = fault.expected(moving=spec.mover is not None)
    orders = [(t, Rung[e.data["action"]]) for t, e in told if "action" in e.data and e.kind == "order"]
    since = [(t, rung) for t, rung in orders if struck is not None and t >= struck - body.period]
    reached = max([layer.spine.order.action, *(rung for _, rung in since)])
    came = next((t for t, rung in since if rung >= expected), None) if expected else None
    return FaultReport(
        f"{fault.source} {fault.kind} {fault.moment}", scene, struck, expected.name, reached.name,
        tuple(dict.fromkeys(str(e.data["check"]) for e in log.trace.events if e.data.get("check"))),
        max(0.0, came - struck) if came is not None and struck is not None else None,
        watched.rest_after(struck), outcome.kind, outcome.reason, unsafe,
        tuple(one for one in violations if one not in unsafe),
    )  # fmt: skip


def errand(body: Body) -> tuple[tuple[str, dict[str, Any]], ...]:
    """Skills and parameters of what is broken: a pick and place, or a drive at full speed."""
    return (("drive_to", DRIVE),) if body.mobile else (("grasp", GRASP), ("place", PLACE))


def _at_the_door(fault: Fault, body: Body, spec: SceneSpec, scene: str, seed: int) -> FaultReport:
    """The same errand, proposed to a gatekeeper; its stamps are true, for the robot is whole."""
    asked = [{"skill": skill, "params": params} for skill, params in errand(body)]
    watched: list[_Watched] = []

    def seen(plant: Plant, world: SimulatedWorld) -> None:
        watched.append(_Watched(plant))
        setattr(world, "advance", watched[0].after(world.advance))  # noqa: B010  (as above)

    found = attend(fault, body, spec, asked, seed, AFTERMATH, seen)
    struck, expected = found.injector.struck, fault.expected(moving=spec.mover is not None)
    orders = [(e.t, Rung[e.data["action"]]) for e in found.trace.events if e.kind == "order" and "action" in e.data]
    since = [(t, rung) for t, rung in orders if struck is not None and t >= struck - body.period]
    came = next((t for t, rung in since if rung >= expected), None) if expected else None
    violations = found.world.judgement().violations
    unsafe = tuple(one for one in violations if one.kind in UNSAFE and watched[0].moved_at(one.start))
    return FaultReport(
        f"{fault.source} {fault.kind} {fault.moment}", scene, struck, expected.name,
        max([Rung[found.final], *(rung for _, rung in since)]).name,
        tuple(dict.fromkeys(str(e.data["check"]) for e in found.trace.events if e.data.get("check"))),
        max(0.0, came - struck) if came is not None and struck is not None else None,
        watched[0].rest_after(struck), found.outcome.kind, found.outcome.reason, unsafe,
        tuple(one for one in violations if one not in unsafe),
    )  # fmt: skip


class _Watched:
    """True times and joint speeds of every period."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self._v: NDArray[np.float64] = plant.data.qvel[plant.arm_slices[1]]  # pyright: ignore[reportUnknownMemberType]
        self.times: list[float] = []
        self._speeds: list[float] = []

    def after(self, advance: Callable[[], None]) -> Callable[[], None]:
        """`advance`, followed by a look at the true state."""

        def watched() -> None:
            advance()
            self.times.append(self._plant.now)
            self._speeds.append(float(np.abs(self._v).max()))

        return watched

    def moved_at(self, when: float) -> bool:
        """Whether the arm moved within the tenth of a second before `when`."""
        t, speed = np.array(self.times), np.array(self._speeds)
        near = (t > when - 0.1) & (t <= when + 1e-9)
        return bool(near.any() and speed[near].max() > AT_REST)

    def rest_after(self, struck: float | None) -> float | None:
        """Time [s] from `struck` until the arm was at rest for good; None if it never was."""
        if struck is None or not self.times or self._speeds[-1] > AT_REST:
            return None
        t, speed = np.array(self.times), np.array(self._speeds)
        moving = t[speed > AT_REST]
        return max(0.0, float(moving[-1]) - struck) if len(moving) else 0.0
