"""Journeys that are blocked by what φ does not know: another way is tried, and when none is left the skill gives up."""

from dataclasses import replace

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.arm.waypoints import NEAR_BASE_RADIUS, follow_waypoints, reach_goal
from dualbrain.skills.progress_watchdog import PROGRESS_TIMEOUT
from dualbrain.skills.skill import Observation, SkillResult, SkillStatus
from dualbrain.skills.time_slicing import run_to_completion

BODY = load_robot("panda")
TABLE = SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)))


class Paper:
    """An arm without physics (q' = u) among obstacles that only the filter knows."""

    def __init__(self, *walls):
        self.safety = SafetyFilter(BODY)
        self.state = home_state(BODY)
        ground = Obstacle(name="table", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)), known=True)
        self.things = [
            ground,
            *(Obstacle(name=f"wall{i}", shape=shape, pose=pose) for i, (shape, pose) in enumerate(walls)),
        ]
        self.limb = ArmController(BODY, self.safety)
        self.phases, self.path, self.now = [], [], 0.0
        self.safety.observe(self.things, 0.0)
        self.sense()

    def sense(self):
        tool = self.safety.tool(self.state.q)
        self.limb.observe(
            Observation(
                state=self.state,
                scene=Scene(robot="panda", stamp=self.now, version=1, objects=(TABLE,)),
                now=self.now,
                tool=tool,
            )
        )
        self.path.append(tool.position.copy())

    def carry_out(self, part, limit=60.0):
        """Run one part of a story to its end; returns what it returned."""
        while self.now < limit:
            try:
                nominal = next(part)
            except StopIteration as over:
                return over.value
            if nominal is None:  # it thinks: here that takes no time
                continue
            if not self.phases or self.phases[-1] != nominal.phase:
                self.phases.append(nominal.phase)
            u = self.safety.filter(self.state, nominal.u, self.now).u
            self.now += BODY.period
            self.state = replace(
                self.state, stamp=self.now, sequence=self.state.sequence + 1, q=self.state.q + BODY.period * u, v=u
            )
            if self.state.sequence % 33 == 0:
                self.safety.observe(self.things, self.now)
            self.sense()
        raise AssertionError("the story did not end")

    def goal(self, *position):
        return run_to_completion(self.limb.find_goal(np.array(position), [self.limb.observation.tool.rotation.copy()]))


def wall(height, start=0.40, end=1.0):
    """Across the way in y, on the table, from x = `start` to `end` [m]."""
    return Box(((end - start) / 2, 0.02, height / 2)), Pose(((start + end) / 2, 0.0, height / 2))


@pytest.fixture(scope="module")
def started():
    """A free arm that has come to the right side of the table."""
    arm = Paper()
    assert arm.carry_out(reach_goal(arm.limb, arm.goal(0.45, -0.25, 0.22), "approach", 0.4)) is None
    return arm.state


def at_the_right(started, *walls):
    arm = Paper(*walls)
    arm.state = replace(started, stamp=0.0, v=np.zeros(BODY.n))
    arm.sense()
    return arm


def test_a_free_way_is_straight(started):
    arm = at_the_right(started)
    assert arm.carry_out(follow_waypoints(arm.limb, [arm.goal(0.45, 0.25, 0.22)], "carry", 0.3)) is None
    heights = np.array(arm.path)[1:, 2]
    assert np.ptp(heights) < 0.03
    assert np.linalg.norm(arm.path[-1] - (0.45, 0.25, 0.22)) < 0.005


def test_when_carrying_is_blocked_the_arm_goes_over_the_top(started):
    arm = at_the_right(started, wall(0.27, 0.30, 0.60))
    assert arm.carry_out(follow_waypoints(arm.limb, [arm.goal(0.45, 0.25, 0.22)], "carry", 0.3)) is None
    assert np.array(arm.path)[1:, 2].max() > 0.35
    assert np.linalg.norm(arm.path[-1] - (0.45, 0.25, 0.22)) < 0.005


def test_when_that_is_blocked_too_it_goes_round_by_the_base(started):
    arm = at_the_right(started, wall(1.2, 0.46))
    assert arm.carry_out(follow_waypoints(arm.limb, [arm.goal(0.45, 0.25, 0.22)], "carry", 0.3)) is None
    assert np.hypot(*np.array(arm.path)[1:, :2].T).min() < NEAR_BASE_RADIUS + 0.05
    assert np.linalg.norm(arm.path[-1] - (0.45, 0.25, 0.22)) < 0.005


def test_when_no_way_is_left_the_skill_says_so_and_gives_up(started):
    arm = at_the_right(started, wall(1.2, 0.25))
    why = arm.carry_out(follow_waypoints(arm.limb, [arm.goal(0.45, 0.25, 0.22)], "carry", 0.3))
    assert isinstance(why, SkillResult)
    assert why.status is SkillStatus.TAKEN_OVER
    assert f"no progress for {PROGRESS_TIMEOUT} s" in why.reason
    assert "cm from the goal" in why.reason
    assert np.array(arm.path)[1:, 1].max() < 0.0  # never through the wall


def test_patience_ends_whatever_the_filter_says(started):
    """A nominal that is let through but leads nowhere ends too: δ has no say in it."""
    arm = at_the_right(started)
    stuck = arm.limb.move_tool(arm.goal(0.45, 0.25, 0.22), "carry", 0.3)
    held, ticks = arm.state, 0
    while True:
        try:
            next(stuck)
        except StopIteration as over:
            why = over.value
            break
        ticks += 1
        arm.now += BODY.period
        arm.state = replace(held, stamp=arm.now, sequence=ticks)
        arm.sense()
    assert why.status is SkillStatus.TAKEN_OVER
    assert PROGRESS_TIMEOUT <= arm.now <= PROGRESS_TIMEOUT + 0.01


def test_giving_way_to_somebody_takes_time_though_nobody_is_seen_any_more(monkeypatch):
    """Who begins a journey again at the moment in which it was broken off would begin it for ever."""
    arm, looks = Paper(), []

    def look(*told, ever=False, **more):
        looks.append(arm.now)
        assert looks.count(arm.now) < 20
        return None if ever else 0.3

    goal = arm.goal(0.5, 0.0, 0.4)
    monkeypatch.setattr(arm.limb, "person_threat_height", look)
    with pytest.raises(AssertionError, match="did not end"):  # a threat that stays is waited for again and again
        arm.carry_out(reach_goal(arm.limb, goal, "carry", 0.3), limit=0.2)
    assert arm.phases == ["yield"]
