"""Estimates of obstacles: always valid, never a fall of h by noise, and introduced at a declared rate after a jump."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.control.obstacle_estimates import (
    INTRODUCTION_RATE,
    MAX_TURN,
    PERSON_ACCELERATION,
    RESERVE,
    ObstacleEstimates,
    with_acceleration,
)
from dualbrain.control.robot_cover import RobotCover, RobotSpheres
from dualbrain.core.geometry.shapes import Box, Pose, Sphere
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Contact, Obstacle

ERROR, RADIUS, PERIOD = 0.009, 0.03, 0.033


def obstacle(x, error=ERROR, name="cup", **fields):
    return Obstacle(name=name, shape=Sphere(RADIUS), pose=Pose((float(x), 0.0, 0.0)), margin=error, **fields)


def robot_at(x, permits=(), age=0.0):
    """One sphere of 5 cm at x on the axis of the obstacles."""
    return RobotCover(
        centres=np.array([[x, 0.0, 0.0]]),
        radii=np.array([0.05]),
        parts=(("left_hand", "hand"),),
        permits=frozenset(permits),
        age=age,
    )


def near(h, age=0.0):
    """The robot whose h from an obstacle at x = 0 is `h`."""
    return robot_at(0.05 + RADIUS + ERROR + h, age=age)


class Updates:
    """Estimates of one obstacle, observed every 33 ms."""

    def __init__(self, robot):
        self.estimates, self.robot, self.now = ObstacleEstimates(), robot, 0.0

    def see(self, *obstacles, moved=(), h_min=-1.0, **options):
        self.now += PERIOD
        return self.estimates.update(obstacles, self.now, moved=moved, h_min=h_min, cover=lambda: self.robot, **options)

    def h(self, estimate):
        return self.robot.clearance(estimate)


def x_of(estimate):
    return estimate.pose.position[0]


@given(seed=st.integers(0, 2**32 - 1), h=st.floats(0.0, 0.01))
@settings(max_examples=50)
def test_an_estimate_of_an_object_at_rest_contains_the_truth_and_noise_makes_no_margin_short(seed, h):
    rng = np.random.default_rng(seed)
    first = rng.uniform(-ERROR, ERROR) / 2
    updates = Updates(near(h + first))
    updates.see(obstacle(first))
    for _ in range(40):
        (got,) = updates.see(obstacle(rng.uniform(-ERROR, ERROR) / 2))
        assert abs(x_of(got)) <= got.margin + 1e-12  # the truth is at 0
        assert updates.h(got) >= min(h, RESERVE) - 1e-12


def test_a_far_observation_is_taken_over_without_computing_the_robot():
    estimates = ObstacleEstimates()
    estimates.update([obstacle(0.0)], 0.0, moved=(), h_min=0.5, cover=lambda: 1 / 0)
    (got,) = estimates.update([obstacle(0.004)], PERIOD, moved=(), h_min=0.5, cover=lambda: 1 / 0)
    assert x_of(got) == 0.004


def test_an_observation_that_would_make_the_margin_short_is_taken_over_in_part_or_not_at_all():
    updates = Updates(near(RESERVE + 0.001))
    updates.see(obstacle(0.0))
    (got,) = updates.see(obstacle(0.003))
    assert 0.0 < x_of(got) < 0.003
    assert updates.h(got) >= RESERVE
    updates.robot = near(0.0002 + x_of(got))
    assert updates.see(obstacle(0.003))[0] == got


def test_an_observation_further_away_is_taken_over_completely():
    updates = Updates(near(0.0))
    updates.see(obstacle(0.0))
    assert x_of(updates.see(obstacle(-0.004))[0]) == -0.004


def test_an_object_that_creeps_is_followed_within_its_error_bound():
    updates = Updates(near(0.0))
    updates.see(obstacle(0.0))
    for k in range(40):
        (got,) = updates.see(obstacle(0.001 * k))
        assert abs(x_of(got) - 0.001 * k) <= ERROR + 1e-12


def test_the_margin_of_an_object_that_moved_is_introduced_at_the_declared_rate():
    updates = Updates(near(0.02))
    updates.see(obstacle(0.0))
    (got,) = updates.see(moved_one := obstacle(0.024))
    assert x_of(got) == 0.024  # the obstacle is at its new place at once
    assert np.isclose(updates.h(got), RESERVE)
    assert got.velocity_error == INTRODUCTION_RATE
    assert np.isclose(updates.estimates.begun["cup"], 0.004 + RESERVE)
    margins = [got.margin]
    while margins[-1] < ERROR:
        (got,) = updates.see(moved_one)
        margins.append(got.margin)
    assert np.allclose(np.diff(margins)[:-1], INTRODUCTION_RATE * PERIOD)
    assert len(margins) <= 2 + (0.004 + RESERVE) / (INTRODUCTION_RATE * PERIOD)
    assert updates.see(moved_one)[0] == moved_one


@pytest.mark.parametrize("age", [0.0, 0.02, 0.05])
def test_the_margin_of_an_old_observation_begins_at_the_reserve_in_the_next_step(age):
    updates = Updates(near(0.02, age))
    updates.see(obstacle(0.0))
    (got,) = updates.see(obstacle(0.024))
    assert np.isclose(updates.h(got), RESERVE)
    assert np.isclose(got.margin, ERROR - 0.004 - RESERVE - INTRODUCTION_RATE * age)
    assert np.isclose(updates.estimates.begun["cup"], 0.004 + RESERVE), "the growth until the step is no shortage"


def test_a_moving_obstacle_counts_where_it_is_in_the_next_step():
    velocity, age = (0.1, 0.0, 0.0), 0.02
    updates = Updates(near(0.05, age))
    updates.see(obstacle(0.0, velocity=velocity, velocity_error=0.02))
    updates.robot = near(0.001, age)
    (got,) = updates.see(obstacle(0.0, velocity=velocity, velocity_error=0.02), moved=("cup",))
    assert np.isclose(got.margin + age * got.velocity_error, ERROR + 0.001 - 0.1 * age - RESERVE)
    assert np.isclose(updates.h(got), RESERVE)


def test_an_obstacle_that_overlaps_the_robot_has_a_negative_h():
    updates = Updates(near(0.0))
    updates.see(obstacle(-0.1))
    (got,) = updates.see(obstacle(0.02))
    assert got.margin == 0.0
    assert updates.h(got) < 0.0


def test_an_obstacle_that_appears_or_was_released_or_is_next_to_a_grasped_object_is_introduced():
    updates = Updates(near(-0.003))
    updates.see()
    assert updates.see(obstacle(0.0))[0].margin < ERROR
    for options in ({"moved": ("cup",)}, {"grasped": True}):
        updates = Updates(near(0.05))
        updates.see(obstacle(0.0))
        updates.robot = near(-0.003)
        (got,) = updates.see(obstacle(0.0), **options)
        assert np.isclose(got.margin, ERROR - 0.003 - RESERVE)


def test_the_first_observation_is_taken_as_it_is():
    updates = Updates(near(-0.003))
    assert updates.see(obstacle(0.0)) == (obstacle(0.0),)


def test_a_moving_obstacle_is_predicted_and_its_margin_grows_with_the_velocity_error():
    updates = Updates(near(0.05))
    velocity = (0.1, 0.0, 0.0)
    updates.see(obstacle(0.0, velocity=velocity, velocity_error=0.02))
    updates.robot = near(0.1 * PERIOD + 0.02 * PERIOD + 0.5 * PERSON_ACCELERATION * PERIOD**2)
    (got,) = updates.see(obstacle(0.1 * PERIOD + 0.004, velocity=velocity, velocity_error=0.02))
    assert np.isclose(x_of(got), 0.1 * PERIOD)
    assert np.isclose(got.margin, ERROR + 0.02 * PERIOD + 0.5 * PERSON_ACCELERATION * PERIOD**2)
    assert got.velocity == velocity


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=50)
def test_the_estimate_of_a_person_contains_the_truth_while_the_acceleration_is_bounded(seed):
    rng, updates, dt = np.random.default_rng(seed), Updates(near(0.02)), 0.001
    x, v, bound = 0.0, 0.0, 0.02
    for _ in range(60):
        x_seen, v_seen = x + rng.uniform(-ERROR, ERROR), v + rng.uniform(-bound, bound)
        seen = obstacle(x_seen, velocity=(v_seen, 0.0, 0.0), velocity_error=bound)
        updates.robot = near(x + rng.uniform(-0.01, 0.01))
        (got,) = updates.see(with_acceleration(seen, PERIOD))
        for step in range(33):
            age = step * dt
            reach = got.margin + bound * age
            if got.velocity_error == bound:  # its margin is not being introduced
                assert abs(x - x_of(got) - age * got.velocity[0]) <= reach + 1e-9
            a = rng.uniform(-PERSON_ACCELERATION, PERSON_ACCELERATION)
            x, v = x + v * dt + 0.5 * a * dt * dt, v + a * dt


def test_the_acceleration_enlarges_the_margin_of_moving_obstacles_only():
    assert with_acceleration(obstacle(0.0), 0.1) == obstacle(0.0)
    moving = with_acceleration(obstacle(0.0, velocity_error=0.02), 0.1)
    assert np.isclose(moving.margin, ERROR + 0.5 * PERSON_ACCELERATION * 0.01)
    assert moving.velocity_error == 0.02


def box(angle):
    quaternion = (float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2)))
    return Obstacle(
        name="cup", shape=Box((RADIUS, RADIUS, RADIUS)), pose=Pose((0.0, 0.0, 0.0), quaternion), margin=ERROR
    )


def test_a_small_turn_grows_the_margin_and_a_large_one_replaces_the_estimate():
    updates = Updates(near(0.0))
    updates.see(box(0.0))
    small = 0.5 * MAX_TURN / (RADIUS * np.sqrt(3))
    (got,) = updates.see(box(small))
    assert ERROR <= got.margin <= ERROR + MAX_TURN
    (got,) = updates.see(box(0.3))
    assert got.margin <= ERROR
    assert got.pose == box(0.3).pose


def test_permitted_pairs_have_no_clearance():
    cover = robot_at(0.09, permits={("hand", "cup")})
    assert cover.clearance(obstacle(0.0)) == np.inf
    assert robot_at(0.09, permits={("hand", "mug")}).clearance(obstacle(0.0)) < 0.1


@pytest.mark.parametrize("age", [0.0, 0.04])
def test_the_cover_of_a_robot_gives_the_barrier_value_of_the_filter(age):
    model = load_robot("panda")
    safety, state = SafetyFilter(model), home_state(model)
    tool = safety.tool(state.q)
    safety.attach([[0.0, 0.0, 0.05, 0.03]], 0.009)
    x, y, z = tool.position.tolist()
    pose = Pose((x, y + 0.105, z - 0.03))
    cup = Obstacle(
        name="cup", shape=Sphere(0.03), pose=pose, margin=0.009, velocity=(0.0, -0.05, 0.02), velocity_error=0.02
    )
    safety.observe([cup], stamp=1.0)
    result = safety(state.q, state.v, np.zeros(model.n), 1.0 + age, state.opening)
    cover = RobotSpheres(safety).at(state, age)
    assert abs(cover.clearance(cup) - result.h_min) < 5e-5
    groups = {part for parts in cover.parts for part in parts}
    assert min(cover.part_clearance(part, cup) for part in groups) == cover.clearance(cup)
    safety.permit([Contact("fingers", "cup", 0.05)])
    safety(state.q, state.v, np.zeros(model.n), 1.0 + age, state.opening)
    rows = [row for row in safety.rows() if "cup" in row.name and not safety.is_permitted(row.kind, row.i, row.j)]
    permitted = RobotSpheres(safety).at(state, age)
    assert abs(permitted.clearance(cup) - min(row.h for row in rows)) < 5e-5
    assert permitted.clearance(cup) > permitted.part_clearance("fingers", cup) == cover.clearance(cup)
    assert cover.part_clearance("tail", cup) == np.inf


@pytest.mark.parametrize("robot", ["panda", "ur5e", "base", "mobile_panda"])
def test_the_cover_of_a_moving_robot_is_ahead_by_the_lag_of_joints_and_base(robot):
    model = load_robot(robot)
    compared = 0
    for seed in range(8):
        safety, at_home = SafetyFilter(model), home_state(model)
        state = replace(at_home, v=np.random.default_rng(seed).uniform(-0.3, 0.3, model.n))
        centres, radii, _ = safety.spheres(state.q, state.opening)
        foremost = int(np.argmax(centres[:, 0] + radii))
        centre = centres[foremost] + (radii[foremost] + 0.062, 0.0, 0.0)
        cup = Obstacle(name="cup", shape=Sphere(0.05), pose=Pose(tuple(centre.tolist())), margin=0.009)
        safety.observe([cup], 0.0)
        safety.filter(state, state.v, 0.0)
        rows = [row.h for row in safety.rows() if "cup" in row.name]
        if rows:
            compared += 1
            assert abs(RobotSpheres(safety).at(state).clearance(cup) - min(rows)) < 5e-5
    assert compared > 0


def test_an_introduced_margin_leaves_h_of_the_filter_intact_though_the_observation_is_old():
    """The object moves next to the robot; it was observed 33 ms before the step."""
    model = load_robot("panda")
    safety, state = SafetyFilter(model), home_state(model)
    spheres, estimates = RobotSpheres(safety), ObstacleEstimates()
    x, y, z = safety.tool(state.q).position.tolist()

    def cup_at(offset):
        return Obstacle(name="cup", shape=Sphere(0.03), pose=Pose((x, y + offset, z)), margin=ERROR)

    def step(offset, stamp):
        found = estimates.update(
            [cup_at(offset)], stamp, moved=(), h_min=0.0, cover=lambda: spheres.at(state, age=PERIOD)
        )
        safety.observe(found, stamp)
        return safety(state.q, state.v, np.zeros(model.n), stamp + PERIOD, state.opening)

    free = step(0.3, 0.0)
    gap = next(offset for offset in np.arange(0.3, 0.0, -0.001) if spheres.at(state).clearance(cup_at(offset)) < -0.004)
    result = step(gap, 0.1)
    assert estimates.begun["cup"] > 0.004
    assert free.h_min > result.h_min > 0.9 * RESERVE
