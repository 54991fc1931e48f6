"""One injected episode in lockstep: an errand that breaks at its moment, judged by the independent monitor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.control_loop import ControlLoopConfig, LoopInputs, LoopObserver
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.evaluation.fault_injection.faults import (
    Fault,
    FaultInjector,
    FaultyRobot,
    FaultyWorld,
    faulty_clock,
    inject_filter_fault,
)
from dualbrain.evaluation.fault_injection.gatekeeper_trial import run_gatekeeper_trial
from dualbrain.records import Violation
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.runtime.assembly import SimulatedCell
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.world import SimulatedWorld, make_world

GRASP_PARAMS = {
    "object": "red_cube",
    "speed": 0.35,
    "clearance": 0.15,
    "finger_axis": "along",
    "opening": 0.08,
    "approach": "top",
    "wait": "none",
    "force": 20.0,
}
PLACE_PARAMS = {"destination": "blue_bowl", "speed": 0.35, "clearance": 0.15, "route": "direct", "wait": "none"}
DRIVE_PARAMS = {"place": "shelf", "max_speed": 0.6, "max_turn_rate": 1.0}
UNSAFE_VIOLATIONS = (
    "collision_env",
    "collision_human",
    "self_collision",
    "collision_held",
    "joint_limit",
    "joint_velocity",
)
"""Kinds of violation that a fault must not lead to; others (a load that was let go) are listed."""
REST_SPEED = 0.02
"""An arm whose joints are slower than this [rad/s] is touched; it does not touch."""
COMMANDER_SOURCES = ("planner", "socket")
"""Sources beyond the gatekeeper's door."""
SETTLE_TIME, AFTERMATH_TIME = 1.0, 0.5
"""How long the local layer goes on after the contract, and the world after that [s]."""


class FaultReport(msgspec.Struct, frozen=True, kw_only=True):
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
        return self.struck is None or SafetyAction[self.reached] >= SafetyAction[self.expected]


def run_fault_trial(fault: Fault, *, robot: str = "panda", scene: str = "tabletop:1", seed: int = 0) -> FaultReport:
    """Carry out a pick and place of the red cube (or a drive to the shelf) that breaks by `fault`.

    Nothing of it reaches a memory.
    """
    robot_model, spec = load_robot(robot), open_scene(scene, robot)
    if fault.source in COMMANDER_SOURCES:
        return _trial_through_gatekeeper(fault, robot_model, spec, scene, seed)
    world = make_world(spec, robot_model, seed=seed)
    plant = world.plant
    injector = FaultInjector(fault, lambda: plant.now)
    safety = SafetyFilter(robot_model)
    inject_filter_fault(safety, injector)
    events: list[tuple[float, Event]] = []  # with true times: the robot's own stamps may be faulty
    log = FlightLog(Trace(robot_model.n, robot_model.nq), None, lambda event: events.append((plant.now, event)))
    motion = _MotionRecorder(plant)
    setattr(world, "advance", motion.wrap(world.advance))  # noqa: B010  (an observer of ground truth, for this world)
    cell = SimulatedCell(
        robot_model,
        world,
        safety=safety,
        log=log,
        config=ControlLoopConfig(settle_time=SETTLE_TIME),
        observer=LoopObserver(on_phase=lambda phase, roles: injector.set_phase(phase)),
        inputs=LoopInputs(clock=faulty_clock(lambda: plant.now, injector)),
        robot=FaultyRobot(plant, injector, robot_model),
        environment=FaultyWorld(world, injector),
    )
    contract = Contract("c-0001", Context(robot, ""), tuple(Action(*one) for one in trial_actions(robot_model)))
    outcome = cell.executor.execute(contract)
    for _ in range(round(AFTERMATH_TIME / robot_model.period)):  # physics continues after the contract
        world.advance()
    struck = injector.triggered_at
    violations = world.judgement().violations
    unsafe = tuple(one for one in violations if one.kind in UNSAFE_VIOLATIONS and motion.was_moving_at(one.start))
    expected = fault.expected_action(scene_moves=spec.mover is not None)
    orders = [(t, SafetyAction[e.data["action"]]) for t, e in events if "action" in e.data and e.kind == "order"]
    since = [(t, action) for t, action in orders if struck is not None and t >= struck - robot_model.period]
    reached = max([cell.loop.safety_controller.decision.action, *(action for _, action in since)])
    came = next((t for t, action in since if action >= expected), None) if expected else None
    return FaultReport(
        fault=f"{fault.source} {fault.kind} {fault.moment}",
        scene=scene,
        struck=struck,
        expected=expected.name,
        reached=reached.name,
        checks=tuple(dict.fromkeys(str(e.data["check"]) for e in log.trace.events if e.data.get("check"))),
        reaction=max(0.0, came - struck) if came is not None and struck is not None else None,
        rest=motion.time_to_rest(struck),
        outcome=outcome.kind,
        reason=outcome.reason,
        unsafe=unsafe,
        other=tuple(one for one in violations if one not in unsafe),
    )


def trial_actions(robot_model: RobotModel) -> tuple[tuple[str, dict[str, Any]], ...]:
    """Skills and parameters of what is broken: a pick and place, or a drive at full speed."""
    return (
        (("drive_to", DRIVE_PARAMS),) if robot_model.is_mobile else (("grasp", GRASP_PARAMS), ("place", PLACE_PARAMS))
    )


def _trial_through_gatekeeper(
    fault: Fault, robot_model: RobotModel, spec: SceneSpec, scene: str, seed: int
) -> FaultReport:
    """The same errand, proposed to a gatekeeper; its stamps are true, for the robot is whole."""
    asked = [{"skill": skill, "params": params} for skill, params in trial_actions(robot_model)]
    watched: list[_MotionRecorder] = []

    def seen(plant: Plant, world: SimulatedWorld) -> None:
        watched.append(_MotionRecorder(plant))
        setattr(world, "advance", watched[0].wrap(world.advance))  # noqa: B010  (as above)

    found = run_gatekeeper_trial(fault, robot_model, spec, asked, seed, AFTERMATH_TIME, seen)
    struck, expected = found.injector.triggered_at, fault.expected_action(scene_moves=spec.mover is not None)
    orders = [
        (e.t, SafetyAction[e.data["action"]]) for e in found.trace.events if e.kind == "order" and "action" in e.data
    ]
    since = [(t, rung) for t, rung in orders if struck is not None and t >= struck - robot_model.period]
    came = next((t for t, rung in since if rung >= expected), None) if expected else None
    violations = found.world.judgement().violations
    unsafe = tuple(one for one in violations if one.kind in UNSAFE_VIOLATIONS and watched[0].was_moving_at(one.start))
    return FaultReport(
        fault=f"{fault.source} {fault.kind} {fault.moment}",
        scene=scene,
        struck=struck,
        expected=expected.name,
        reached=max([SafetyAction[found.final_action], *(rung for _, rung in since)]).name,
        checks=tuple(dict.fromkeys(str(e.data["check"]) for e in found.trace.events if e.data.get("check"))),
        reaction=max(0.0, came - struck) if came is not None and struck is not None else None,
        rest=watched[0].time_to_rest(struck),
        outcome=found.outcome.kind,
        reason=found.outcome.reason,
        unsafe=unsafe,
        other=tuple(one for one in violations if one not in unsafe),
    )


class _MotionRecorder:
    """True times and joint speeds of every period."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self._v: NDArray[np.float64] = plant.data.qvel[plant.arm_slices[1]]  # pyright: ignore[reportUnknownMemberType]
        self.times: list[float] = []
        self._speeds: list[float] = []

    def wrap(self, advance: Callable[[], None]) -> Callable[[], None]:
        """`advance`, followed by a look at the true state."""

        def watched() -> None:
            advance()
            self.times.append(self._plant.now)
            self._speeds.append(float(np.abs(self._v).max()))

        return watched

    def was_moving_at(self, when: float) -> bool:
        """Whether the arm moved within the tenth of a second before `when`."""
        t, speed = np.array(self.times), np.array(self._speeds)
        near = (t > when - 0.1) & (t <= when + 1e-9)
        return bool(near.any() and speed[near].max() > REST_SPEED)

    def time_to_rest(self, struck: float | None) -> float | None:
        """Time [s] from `struck` until the arm was at rest for good; None if it never was."""
        if struck is None or not self.times or self._speeds[-1] > REST_SPEED:
            return None
        t, speed = np.array(self.times), np.array(self._speeds)
        moving = t[speed > REST_SPEED]
        return max(0.0, float(moving[-1]) - struck) if len(moving) else 0.0
