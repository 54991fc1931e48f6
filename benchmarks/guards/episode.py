"""One episode: a policy behind a guard on the plant, judged on the plant's own shapes at every millisecond."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.guards.guards.dualbrain_guard import DualbrainGuard
from benchmarks.guards.guards.guard import BenchmarkedGuard, ClosableGuard, TargetGuard
from benchmarks.guards.guards.hand_filter import HandFilter
from benchmarks.guards.guards.path_braking import CLEARANCE, PathBraking
from benchmarks.guards.guards.relative_clamp import RelativeClamp
from benchmarks.guards.guards.robot_dam.guard import RobotDam
from benchmarks.guards.learned_policy import LearnedPolicy
from benchmarks.guards.policies import PERIOD, CarefulPolicy, CarelessPolicy, Policy, RandomPolicy
from benchmarks.guards.robot_interface import RobotInterface
from benchmarks.guards.scene import GuardScene, is_clear, load_panda
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.stepped_plant import SteppedPlant
from experiments.safety.plant_judge import PlantJudge

Array = NDArray[np.float64]
GuardFactory = Callable[[GuardScene, RobotInterface], BenchmarkedGuard]

DURATION, RANDOM_DURATION = 10.0, 5.0
"""Longest time of an episode with a goal, and length of one without [s]."""
GOAL_TOLERANCE, REST_SPEED = 0.05, 0.05
"""At the goal every joint is this close [rad] and this slow [rad/s]."""
STANDSTILL_SPEED, STANDSTILL_DURATION = 0.005, 1.5
"""An episode with a goal ends when no joint was faster for this time [rad/s, s]: nothing changes any more."""

POLICIES: dict[str, Callable[[GuardScene, np.random.Generator], Policy]] = {
    "careful": CarefulPolicy,
    "learned": LearnedPolicy,
    "careless": CarelessPolicy,
    "random": RandomPolicy,
}


def _path_braking(scene: GuardScene, interface: RobotInterface) -> BenchmarkedGuard:
    _, judge = load_panda()
    return PathBraking(interface, PERIOD, lambda q: is_clear(judge, q, scene.obstacles, CLEARANCE))


def _robot_dam(scene: GuardScene, interface: RobotInterface) -> BenchmarkedGuard:
    robot_model, _ = load_panda()
    kinematics = SafetyFilter(robot_model)

    def tool(q: Array) -> tuple[Array, Array]:
        state = kinematics.tool(q)
        return state.position, state.jacobian[:3]

    return RobotDam(robot_model, scene.obstacles, interface, PERIOD, tool)


GUARDS: dict[str, GuardFactory] = {
    "unguarded": lambda _scene, interface: TargetGuard(interface, PERIOD),
    "LeRobot clamp": lambda _scene, interface: RelativeClamp(interface, PERIOD),
    "robot-dam": _robot_dam,
    "hand-only CBF": lambda scene, interface: HandFilter(load_panda()[0], scene.obstacles, interface, PERIOD),
    "path braking": _path_braking,
    "dualbrain": lambda scene, interface: DualbrainGuard(load_panda()[0], scene.obstacles, interface, PERIOD),
    "dualbrain, along path": lambda scene, interface: DualbrainGuard(
        load_panda()[0], scene.obstacles, interface, PERIOD, "along_path"
    ),
}


def run_episode(scene: GuardScene, policy_name: str, guard_name: str, duration: float | None = None) -> dict[str, Any]:
    """Run one policy behind one guard for `duration` [s] at most, by default the time of its kind.

    The row states contacts, the time to the goal, and the cost per action.
    """
    return run_guarded(scene, policy_name, lambda _plant, interface: GUARDS[guard_name](scene, interface), duration)


def run_guarded(
    scene: GuardScene,
    policy_name: str,
    make_guard: Callable[[Plant, RobotInterface], BenchmarkedGuard],
    duration: float | None = None,
) -> dict[str, Any]:
    """As `run_episode`, behind a guard that may use sensors of the plant."""
    robot_model, _ = load_panda()
    plant = scene.make_plant()
    robot, judge = SteppedPlant(plant, contacts=False), PlantJudge(plant)
    interface = RobotInterface(robot_model, scene.start)
    policy = POLICIES[policy_name](scene, np.random.default_rng([scene.seed, 11]))
    guard = make_guard(plant, interface)
    goal = scene.goal if policy_name != "random" else None
    longest = duration or (RANDOM_DURATION if goal is None else DURATION)
    try:
        reached, costs = _run(robot, judge, interface, policy, guard, goal, longest)
    finally:
        if isinstance(guard, ClosableGuard):
            guard.close()
    return {
        "contact": judge.n_below_zero > 0,
        "min_scene_distance": float(judge.min_scene_distance),
        "min_self_distance": float(judge.min_self_distance),
        "reached": reached,
        "action_us": np.percentile(costs, (50, 99)).round(1).tolist(),
    }


def _run(
    robot: SteppedPlant,
    judge: PlantJudge,
    interface: RobotInterface,
    policy: Policy,
    guard: BenchmarkedGuard,
    goal: Array | None,
    duration: float,
) -> tuple[float | None, list[float]]:
    """Time at which the arm rests at the goal [s], None without, and processor time of the guard per action [us]."""
    steps, costs, moved_at = round(PERIOD / interface.period), list[float](), 0.0
    for action in range(round(duration / PERIOD)):
        robot.measure()
        now, spent = action * PERIOD, 0.0
        if np.abs(robot.v).max() > STANDSTILL_SPEED:
            moved_at = now
        if goal is not None and _is_at_goal(robot, goal):
            return now, costs
        if goal is not None and now > moved_at + STANDSTILL_DURATION:
            break
        target = policy.act(robot.q.copy())
        for step in range(steps):
            if step:
                robot.measure()
            judge.update()
            q, v, at = robot.q.copy(), robot.v.copy(), now + step * interface.period
            begin = perf_counter()
            if step == 0:
                guard.begin(target, q, at)
            u = guard.velocity(q, v, at)
            spent += perf_counter() - begin
            robot.apply(interface.limit(u))
        costs.append(spent * 1e6)
    return None, costs


def _is_at_goal(robot: SteppedPlant, goal: Array) -> bool:
    return bool(np.all(np.abs(robot.q - goal) < GOAL_TOLERANCE) and np.all(np.abs(robot.v) < REST_SPEED))
