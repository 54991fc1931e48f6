"""Motions blocked by an obstacle that only the filter knows: the skill tries other waypoints and then gives up."""

import re
from dataclasses import replace

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.skills.arm.controller import ArmController, ToolGoal
from dualbrain.skills.arm.waypoints import NEAR_BASE_RADIUS, follow_waypoints, reach_goal
from dualbrain.skills.kinematics.object_geometry import axis_rotation
from dualbrain.skills.progress_watchdog import PROGRESS_TIMEOUT
from dualbrain.skills.skill import Observation, SkillResult, SkillStatus
from dualbrain.skills.time_slicing import run_to_completion

BODY = load_robot("panda")
TABLE = SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)))


class KinematicCell:
    """An arm without physics (q' = u) among obstacles that only the filter knows."""

    def __init__(self, *walls):
        self.safety = SafetyFilter(BODY)
        self.state = home_state(BODY)
        ground = Obstacle(name="table", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)), known=True)
        self.obstacles = [
            ground,
            *(Obstacle(name=f"wall{i}", shape=shape, pose=pose) for i, (shape, pose) in enumerate(walls)),
        ]
        self.controller = ArmController(BODY, self.safety)
        self.phases, self.path, self.now, self.paused = [], [], 0.0, 0.0
        self.safety.observe(self.obstacles, 0.0)
        self.observe()

    def observe(self):
        tool = self.safety.tool(self.state.q)
        self.controller.observe(
            Observation(
                state=self.state,
                scene=Scene(robot="panda", stamp=self.now, version=1, objects=(TABLE,)),
                now=self.now,
                tool=tool,
                paused_time=self.paused,
            )
        )
        self.path.append(tool.position.copy())

    def pause(self, seconds):
        """Let `seconds` pass during which an operator pauses the routine; the next observation shows it."""
        self.now += seconds
        self.paused += seconds

    def carry_out(self, routine, limit=60.0):
        """Run `routine` to its end and return its result; AssertionError after `limit` [s]."""
        while self.now < limit:
            try:
                nominal = next(routine)
            except StopIteration as end:
                return end.value
            if nominal is None:  # the controller computes; here that takes no time
                continue
            if not self.phases or self.phases[-1] != nominal.phase:
                self.phases.append(nominal.phase)
            u = self.safety.filter(self.state, nominal.u, self.now).u
            self.now += BODY.period
            self.state = replace(
                self.state, stamp=self.now, sequence=self.state.sequence + 1, q=self.state.q + BODY.period * u, v=u
            )
            if self.state.sequence % 33 == 0:
                self.safety.observe(self.obstacles, self.now)
            self.observe()
        raise AssertionError("the routine did not end")

    def goal(self, *position):
        rotations = [self.controller.observation.tool.rotation.copy()]
        return run_to_completion(self.controller.find_goal(np.array(position), rotations))


def wall(height, start=0.40, end=1.0):
    """A wall in the plane y = 0 on the table, from x = `start` to `end` [m]."""
    return Box(((end - start) / 2, 0.02, height / 2)), Pose(((start + end) / 2, 0.0, height / 2))


@pytest.fixture(scope="module")
def started():
    """State of an arm that has moved without obstacles to the right side of the table."""
    cell = KinematicCell()
    assert cell.carry_out(reach_goal(cell.controller, cell.goal(0.45, -0.25, 0.22), "approach", 0.4)) is None
    return cell.state


def at_the_right(started, *walls):
    cell = KinematicCell(*walls)
    cell.state = replace(started, stamp=0.0, v=np.zeros(BODY.n))
    cell.observe()
    return cell


def carry_to_the_left(cell):
    goal = cell.goal(0.45, 0.25, 0.22)
    return cell.carry_out(follow_waypoints(cell.controller, [goal], "carry", 0.3))


def test_a_motion_without_obstacles_is_straight(started):
    cell = at_the_right(started)
    assert carry_to_the_left(cell) is None
    heights = np.array(cell.path)[1:, 2]
    assert np.ptp(heights) < 0.03
    assert np.linalg.norm(cell.path[-1] - (0.45, 0.25, 0.22)) < 0.005


def test_when_carrying_is_blocked_the_arm_goes_over_the_top(started):
    cell = at_the_right(started, wall(0.27, 0.30, 0.60))
    assert carry_to_the_left(cell) is None
    assert np.array(cell.path)[1:, 2].max() > 0.35
    assert np.linalg.norm(cell.path[-1] - (0.45, 0.25, 0.22)) < 0.005


def test_when_that_is_blocked_too_it_goes_round_by_the_base(started):
    cell = at_the_right(started, wall(1.2, 0.46))
    assert carry_to_the_left(cell) is None
    assert np.hypot(*np.array(cell.path)[1:, :2].T).min() < NEAR_BASE_RADIUS + 0.05
    assert np.linalg.norm(cell.path[-1] - (0.45, 0.25, 0.22)) < 0.005


def test_when_every_alternative_is_blocked_the_skill_reports_it_and_gives_up(started):
    cell = at_the_right(started, wall(1.2, 0.25))
    result = carry_to_the_left(cell)
    assert isinstance(result, SkillResult)
    assert result.status is SkillStatus.TAKEN_OVER
    assert f"no progress for {PROGRESS_TIMEOUT} s" in result.reason
    assert "cm from the goal" in result.reason
    assert np.array(cell.path)[1:, 1].max() < 0.0  # never through the wall


@pytest.mark.parametrize(("missing", "complete"), [(0.01, True), (0.05, False)])
def test_a_motion_that_is_blocked_near_its_goal_suffices_where_another_one_follows(missing, complete):
    """A block below the fingers keeps the tool at least `missing` [m] above its goal."""
    free = KinematicCell()
    tool, fall = free.path[0], 0.08
    centres, radii, _ = free.safety.spheres(free.state.q, free.state.opening)
    hand = np.linalg.norm(centres - tool, axis=1) < 0.1
    top = float(np.min((centres[:, 2] - radii)[hand])) - fall + missing
    block = Box((0.1, 0.1, top / 2)), Pose((tool[0], tool[1], top / 2))
    for near_suffices in (False, True):
        cell = KinematicCell(block)
        goal = cell.goal(tool[0], tool[1], tool[2] - fall)
        result = cell.carry_out(reach_goal(cell.controller, goal, "approach", 0.2, near_suffices=near_suffices))
        if near_suffices and complete:
            assert result is None
        else:
            assert result.status is SkillStatus.TAKEN_OVER
        assert missing - 0.002 < cell.path[-1][2] - goal.position[2] < missing + 0.01


def test_a_rotation_beyond_a_joint_limit_is_reported_with_the_angle(started):
    """The tool is at its goal; the last joint ends before the rotation is reached."""
    cell = at_the_right(started)
    q = cell.state.q.copy()
    q[-1] = BODY.joints[-1].upper.value - 0.05
    cell.state = replace(cell.state, q=q)
    cell.observe()
    tool = cell.controller.observation.tool
    goal = ToolGoal(tool.position, tool.rotation @ axis_rotation((0.0, 0.0, 1.0), 2.0), q)
    result = cell.carry_out(reach_goal(cell.controller, goal, "approach", 0.3))
    assert result.status is SkillStatus.TAKEN_OVER
    reason = re.search(r"0\.\d cm from the goal and turned by (\d+)°$", result.reason)
    assert int(reason[1]) > 10


def test_the_progress_timeout_does_not_depend_on_the_filter(started):
    """A nominal control that the filter does not change, but that makes no progress, ends too."""
    cell = at_the_right(started)
    routine = cell.controller.move_tool(cell.goal(0.45, 0.25, 0.22), "carry", 0.3)
    fixed_state, ticks = cell.state, 0
    while True:
        try:
            next(routine)
        except StopIteration as end:
            result = end.value
            break
        ticks += 1
        cell.now += BODY.period
        cell.state = replace(fixed_state, stamp=cell.now, sequence=ticks)
        cell.observe()
    assert result.status is SkillStatus.TAKEN_OVER
    assert PROGRESS_TIMEOUT <= cell.now <= PROGRESS_TIMEOUT + 0.01


def test_avoiding_a_person_takes_time_even_if_the_person_is_no_longer_seen(monkeypatch):
    """A motion restarted at the same instant in which it was interrupted would restart forever."""
    cell, calls = KinematicCell(), []

    def threat_height(*_, any_height=False, **__):
        calls.append(cell.now)
        assert calls.count(cell.now) < 20
        return None if any_height else 0.3

    goal = cell.goal(0.5, 0.0, 0.4)
    monkeypatch.setattr(cell.controller, "person_threat_height", threat_height)
    with pytest.raises(AssertionError, match="did not end"):  # the controller keeps waiting while the threat stays
        cell.carry_out(reach_goal(cell.controller, goal, "carry", 0.3), limit=0.2)
    assert cell.phases == ["yield"]
