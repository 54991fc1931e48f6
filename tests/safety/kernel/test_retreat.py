"""Retreat from approaching obstacles: the decision against numpy in random cases, and closed loops."""

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.robots.interface import RobotState
from dualbrain.safety.cbf.filter import FilterStatus, Obstacle, SafetyFilter
from dualbrain.safety.stop_cause import Reason
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.state_monitor import result_conditions
from tests.safety import random_scenes
from tests.safety.kernel_step.reference_rows import OBSTACLE
from tests.safety.kernel_step.test_step_internals import run_both

SHARE = 0.5
"""Fraction of the acceleration along a row that the retreat may need."""


def ends_approach(w, name, u):
    """Whether the retreat that `u` begins ends the approach along a row in time, from the definition."""
    a, b, h, norm, clipped, moving, _ = w.rows[name]
    gap = (h - w.model["sampling"]) / norm
    if name[0] != OBSTACLE or not moving or clipped or gap <= 0.0:
        return False
    required = b + w.alpha(w.obstacles[name[2]]) * gap
    closing, dt = required - a @ u, w.model["period"]
    acceleration = SHARE * max(a @ (u - w.case.u_prev), 0.0) / dt
    distance = 0.0 if closing <= 0.0 else np.inf
    if closing > 0.0 and acceleration > 0.0:
        distance = (closing**2 / acceleration + closing * dt) / 2.0  # in periods of constant deceleration
    return distance <= gap and required <= np.abs(a) @ w.model["v_max"]


@pytest.mark.parametrize("times", [250, pytest.param(400, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["everything", "mobile", "balls"])
def test_a_step_retreats_if_every_violated_row_is_of_an_obstacle_that_it_evades(kind, times):
    rng, seen = np.random.default_rng(len(kind)), {True: 0, False: 0}
    for _ in range(times):
        found = run_both(rng, 7, 6, kind, crowded=False)
        if found is None:
            continue
        _, _, _, answer, got, w = found
        values = got["rows"]
        names = {tuple(int(values[e][r]) for e in ("kind", "i", "j")) for r in range(int(values["count"][0]))}
        if answer.status != FilterStatus.RELAXED or names != set(w.rows) or answer.flags & Reason.UNAVOIDABLE:
            assert answer.status == FilterStatus.RELAXED or not answer.flags & Reason.RETREAT
            continue
        u = np.array(answer.u)
        violated = [name for name, row in w.rows.items() if row[0] @ u < row[1] - 1e-7]
        if not violated:  # a violation within the tolerance is none, or one
            continue
        expected = all(ends_approach(w, name, u) for name in violated)
        assert bool(answer.flags & Reason.RETREAT) == expected
        seen[expected] += 1
    assert min(seen.values()) > 1, seen


def approach(robot, speed, distance, *, stops=True):
    """Results of a robot at rest to which a sphere moves from `distance` [m] at `speed` [m/s] for 60 mm."""
    safety, q, results = SafetyFilter(robot, random_scenes.exact_config()), np.array(robot.home), []
    tool = safety.tool(q).position
    for k in range(400):
        travelled = min(speed * k * robot.period, 0.06)
        moves = not stops or travelled < 0.06
        at = tool + np.array([0.05 + 0.05 + distance - travelled, 0.0, 0.0])
        velocity = (-speed if moves else 0.0, 0.0, 0.0)
        stamp = k * robot.period
        safety.observe([Obstacle("arm", Sphere(0.05), Pose(tuple(at)), velocity=velocity, static=False)], stamp)
        state = RobotState(stamp=stamp, sequence=k, q=q, v=np.zeros(7), opening=0.0, finger_forces=(0.0, 0.0))
        results.append(safety.filter(state, np.zeros(7), stamp))
        q = q + robot.period * results[-1].u
    return results


def test_a_robot_at_rest_retreats_from_an_obstacle_that_starts_to_move(panda):
    results = approach(panda, 0.4, 0.07)
    relaxed = [result for result in results if result.status is FilterStatus.RELAXED]
    assert relaxed, "the rows of the obstacle ask for more than the joints accelerate in one period"
    assert all(Reason.RETREAT in result.reason and result.certified for result in relaxed)
    assert all(result_conditions(result) == 0 for result in relaxed)
    assert all("retreating" in result.explain() and "in time" in result.explain() for result in relaxed)
    assert min(result.h_min for result in results) >= 0.0


def test_an_obstacle_that_arrives_before_the_retreat_ends_is_infeasible(panda):
    results = approach(panda, 1.2, 0.04)
    late = [r for r in results if r.status is FilterStatus.RELAXED and Reason.RETREAT not in r.reason]
    assert late
    assert all(result_conditions(result) == Condition.INFEASIBLE for result in late)


def test_a_robot_that_moves_toward_a_static_obstacle_has_no_retreat(panda):
    safety = SafetyFilter(panda, random_scenes.exact_config())
    q = np.array(panda.home)
    tool = safety.tool(q).position
    safety.observe([Obstacle("post", Sphere(0.05), Pose((tool[0] + 0.12, tool[1], tool[2])))], 0.0)
    safety.reset(np.array([0.0, 1.5, 0.0, 1.5, 0.0, 0.0, 0.0]))
    result = safety(q, np.zeros(7), np.array([0.0, 1.5, 0.0, 1.5, 0.0, 0.0, 0.0]))
    assert Reason.INFEASIBLE in result.reason
    assert Reason.RETREAT not in result.reason
