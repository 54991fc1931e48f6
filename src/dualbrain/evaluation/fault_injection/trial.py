"""Fault trial: one episode in lockstep with an injected fault, judged by the independent safety monitor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.control_loop import ControlLoopConfig, LoopInputs, LoopObserver
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.errors import ConfigurationError
from dualbrain.evaluation.fault_injection.faults import (
    TARGET,
    Fault,
    FaultInjector,
    FaultyRobot,
    FaultyWorld,
    faulty_clock,
    inject_filter_fault,
)
from dualbrain.evaluation.fault_injection.gatekeeper_trial import run_gatekeeper_trial
from dualbrain.evaluation.fault_injection.target_observer import TargetReport, open_observed_filter
from dualbrain.records import Outcome, Violation
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.runtime.assembly import SimulatedCell
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.world import make_world

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
"""Kinds of violation that a fault must not lead to; others (such as a dropped object) are only listed."""
REST_TRAVEL = 0.01
"""Travel [rad, m] of a joint up to which a robot that is pushed counts as at rest."""
REST_SPEED = 0.02
"""Speed of joints and base [rad/s, m/s] below which the robot is at rest; a contact at rest is not caused by it."""
COMMANDER_SOURCES = ("planner", "socket")
"""Sources on the commander's side of the gatekeeper's server."""
SETTLE_TIME, AFTERMATH_TIME = 1.0, 0.5
"""Time that the control loop continues after the contract, and the simulation after that [s]."""


class FaultReport(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a fault trial; all times in [s].

    `struck`: time of the fault, None if its moment did not occur. `expected`, `reached`: the declared action of the
    supervisor, and the strongest one that followed. `reaction`: time from the fault to the first action that is at
    least the expected one. `rest`: time from the fault until the robot was at rest. `unsafe`: the violations of
    `UNSAFE_VIOLATIONS` while the robot moved; `other`: all others. `target`: how the trial ran on a target, if it did.
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
    target: TargetReport | None = None

    @property
    def safe(self) -> bool:
        """Whether there was no unsafe violation."""
        return not self.unsafe

    @property
    def as_declared(self) -> bool:
        """Whether at least the expected action followed; True for a fault whose moment did not occur."""
        return self.struck is None or SafetyAction[self.reached] >= SafetyAction[self.expected]


def run_fault_trial(
    fault: Fault, *, robot: str = "panda", scene: str = "tabletop:1", seed: int = 0, target: str = ""
) -> FaultReport:
    """Execute a pick and place of the red cube (or a drive to the shelf) with an injected fault.

    Filter and supervisor also run on the emulated board `target`, if it is named. Nothing is stored in a memory.

    Raises:
        UnknownNameError: the robot, the scene or the board is unknown.
        ConfigurationError: the source needs a target, or is impossible with one; or the target cannot be started.
    """
    _require_target(fault, target)
    robot_model, spec = load_robot(robot), open_scene(scene, robot)
    if fault.source in COMMANDER_SOURCES:
        return _trial_through_gatekeeper(fault, robot_model, spec, scene, seed)
    return _trial_in_lockstep(fault, robot_model, spec, scene, seed, target)


def _require_target(fault: Fault, target: str) -> None:
    """Raise `ConfigurationError` if the source of `fault` does not exist with, or without, a target."""
    if fault.source == TARGET and not target:
        raise ConfigurationError.stating(
            "The link to a target can fail only in a trial on a target.", fix="Name a board, such as an500."
        )
    if fault.source in COMMANDER_SOURCES and target:
        raise ConfigurationError.stating(
            f"The source {fault.source} is in front of a gatekeeper, which runs its own filter.",
            fix="Leave out the target.",
        )


def _trial_in_lockstep(
    fault: Fault, robot_model: RobotModel, spec: SceneSpec, scene: str, seed: int, target: str
) -> FaultReport:
    motion = MotionRecorder()
    world = make_world(spec, robot_model, seed=seed, pace=motion)
    plant = world.plant
    motion.observe(plant)
    injector = FaultInjector(fault, lambda: plant.now)
    events: list[tuple[float, Event]] = []  # with true times: the robot's own stamps may be faulty
    log = FlightLog(Trace(robot_model.n, robot_model.nq), None, lambda event: events.append((plant.now, event)))
    actions = tuple(Action(*one) for one in trial_actions(robot_model))
    with open_observed_filter(robot_model, target, injector) as observer:
        inject_filter_fault(observer.safety, injector)
        cell = SimulatedCell(
            robot_model,
            world,
            safety=observer.safety,
            log=log,
            config=ControlLoopConfig(settle_time=SETTLE_TIME),
            observer=LoopObserver(on_phase=lambda phase, roles: injector.set_phase(phase), on_result=observer),
            inputs=LoopInputs(clock=faulty_clock(lambda: plant.now, injector)),
            robot=FaultyRobot(plant, injector, robot_model),
            environment=FaultyWorld(world, injector),
        )
        outcome = cell.executor.execute(Contract("c-0001", Context(robot_model.name, ""), actions))
    for _ in range(round(AFTERMATH_TIME / robot_model.period)):  # physics continues after the contract
        world.advance()
    report = _fault_report(
        fault,
        spec,
        robot_model,
        scene=scene,
        struck=injector.triggered_at,
        orders=[(t, event) for t, event in events if event.kind == "order"],
        final_action=cell.loop.safety_controller.decision.action,
        trace=log.trace,
        outcome=outcome,
        violations=world.judgement().violations,
        motion=motion,
    )
    return msgspec.structs.replace(report, target=observer.report())


def trial_actions(robot_model: RobotModel) -> tuple[tuple[str, dict[str, Any]], ...]:
    """Skills and parameters of a trial: a pick and place, or a drive at full speed."""
    return (
        (("drive_to", DRIVE_PARAMS),) if robot_model.is_mobile else (("grasp", GRASP_PARAMS), ("place", PLACE_PARAMS))
    )


def _trial_through_gatekeeper(
    fault: Fault, robot_model: RobotModel, spec: SceneSpec, scene: str, seed: int
) -> FaultReport:
    """The same trial through a gatekeeper; the stamps are true, because the robot has no fault."""
    actions = [{"skill": skill, "params": params} for skill, params in trial_actions(robot_model)]
    motion = MotionRecorder()
    result = run_gatekeeper_trial(fault, robot_model, spec, actions, seed, AFTERMATH_TIME, motion)
    return _fault_report(
        fault,
        spec,
        robot_model,
        scene=scene,
        struck=result.injector.triggered_at,
        orders=[(event.t, event) for event in result.trace.events if event.kind == "order"],
        final_action=SafetyAction[result.final_action],
        trace=result.trace,
        outcome=result.outcome,
        violations=result.world.judgement().violations,
        motion=motion,
    )


def _fault_report(
    fault: Fault,
    spec: SceneSpec,
    robot_model: RobotModel,
    *,
    scene: str,
    struck: float | None,
    orders: Sequence[tuple[float, Event]],
    final_action: SafetyAction,
    trace: Trace,
    outcome: Outcome,
    violations: Sequence[Violation],
    motion: MotionRecorder,
) -> FaultReport:
    """The report of a trial; `orders` are the supervisor's decisions with their true times [s]."""
    expected = fault.expected_action(scene_moves=spec.mover is not None)
    decisions = [(t, SafetyAction[event.data["action"]]) for t, event in orders if "action" in event.data]
    since = [(t, action) for t, action in decisions if struck is not None and t >= struck - robot_model.period]
    reacted_at = next((t for t, action in since if action >= expected), None) if expected else None
    unsafe = tuple(one for one in violations if one.kind in UNSAFE_VIOLATIONS and motion.was_moving_during(one))
    return FaultReport(
        fault=f"{fault.source} {fault.kind} {fault.moment}",
        scene=scene,
        struck=struck,
        expected=expected.name,
        reached=max([final_action, *(action for _, action in since)]).name,
        checks=tuple(dict.fromkeys(str(event.data["check"]) for event in trace.events if event.data.get("check"))),
        reaction=max(0.0, reacted_at - struck) if reacted_at is not None and struck is not None else None,
        rest=motion.time_to_rest(struck),
        outcome=outcome.kind,
        reason=outcome.reason,
        unsafe=unsafe,
        other=tuple(one for one in violations if one not in unsafe),
    )


class MotionRecorder:
    """Records the true time [s] and the largest speed of joints and base [rad/s, m/s] of every period."""

    def __init__(self) -> None:
        self.times: list[float] = []
        self._speeds: list[float] = []
        self._speed: Callable[[], float] = lambda: 0.0

    def observe(self, plant: Plant) -> None:
        """Record the motion of `plant`, before its first period."""
        self._speed = lambda: _largest_speed(plant)

    def __call__(self, now: float) -> None:
        """Record the true state at `now` [s], the end of a period."""
        self.times.append(now)
        self._speeds.append(self._speed())

    def was_moving_during(self, violation: Violation) -> bool:
        """Whether the robot moved within the tenth of a second before `violation`, or travelled during it.

        A person who pushes against a resting arm moves its joints by less than `REST_TRAVEL`.
        """
        t, speed = np.array(self.times), np.array(self._speeds)
        before = (t > violation.start - 0.1) & (t <= violation.start + 1e-9)
        during = (t > violation.start) & (t <= violation.start + violation.duration + 1e-9)
        moved = bool(before.any() and speed[before].max() > REST_SPEED)
        travel = float((speed * np.diff(t, prepend=t[:1]))[during].sum())
        return moved or travel > REST_TRAVEL

    def time_to_rest(self, struck: float | None) -> float | None:
        """Time [s] from `struck` until the robot was finally at rest; None if it was not."""
        if struck is None or not self.times or self._speeds[-1] > REST_SPEED:
            return None
        t, speed = np.array(self.times), np.array(self._speeds)
        moving = t[speed > REST_SPEED]
        return max(0.0, float(moving[-1]) - struck) if len(moving) else 0.0


def _largest_speed(plant: Plant) -> float:
    """The largest speed [rad/s, m/s] of a joint of the arm, or of the base; the base of an arm has (v, ω)."""
    joints: NDArray[np.float64] = plant.data.qvel[plant.arm_slices[1]]  # pyright: ignore[reportUnknownMemberType]
    base = plant.robot_velocity()[: max(0, plant.robot_model.n - len(joints))]
    return float(np.abs(np.concatenate([joints, base])).max())
