"""Gripping: the judgement of a grip, the least force that holds, and the detection of a load that is lost or slips."""

from dataclasses import replace

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose
from dualbrain.records import FailureCause, Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import PerceptionNoise
from dualbrain.skills.arm import grasp as grasp_skill
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.arm.grasp import GRIP_FORCE_STEP, GRIP_RESERVE, max_grip_force
from dualbrain.skills.arm.load_monitor import DETECTION_TIME, LoadMonitor
from dualbrain.skills.arm.waypoints import move_to_height
from dualbrain.skills.skill import Observation, SkillResult, SkillStatus
from tests.skills.arm.test_skills_in_simulation import SkillCell, grasp, place

PANDA = load_robot("panda")
TABLE = SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)))
PERIOD = 0.001


class FakeHand:
    """An arm at rest whose finger forces, opening and perceived object the test sets."""

    def __init__(self, error=0.0):
        self.motion, self.state = SafetyFilter(PANDA), home_state(PANDA)
        self.tool = self.motion.tool(self.state.q)
        self.error, self.now, self.shift, self.paused = error, 0.0, np.zeros(3), 0.0

    def observe(self, forces, opening=0.02):
        self.now += PERIOD
        stamp = 0.033 * int(self.now / 0.033)
        x, y, z = self.tool.position + self.shift
        cube = SceneObject(
            name="cube",
            role="object",
            shape=Box((0.02, 0.02, 0.02)),
            pose=Pose((x, y, z)),
            error=self.error,
            stamp=stamp,
        )
        return Observation(
            state=replace(self.state, stamp=self.now, opening=opening, finger_forces=forces),
            scene=Scene(robot="panda", stamp=stamp, version=1, objects=(TABLE, cube)),
            now=self.now,
            tool=self.tool,
            paused_time=self.paused,
        )


def close(reading):
    """Result and duration of closing at 5 N if `reading(t)` gives the finger forces [N] and the opening [m]."""
    hand = FakeHand()
    arm = ArmController(PANDA, hand.motion)
    arm.observe(hand.observe(*reading(0.0)))
    routine = arm.close_gripper(5.0)
    while True:
        try:
            next(routine)
        except StopIteration as over:
            return over.value, hand.now
        arm.observe(hand.observe(*reading(hand.now)))


@pytest.mark.parametrize("speed", [0.0, 0.0017, 0.004])
def test_a_grip_whose_opening_creeps_is_a_grip(speed):
    """An object that is gripped askew turns between the fingers, which press all the time."""
    failure, duration = close(lambda t: ((0.0, 0.0), 0.03) if t < 0.3 else ((39.0, 52.0), 0.025 - speed * (t - 0.3)))
    assert failure is None
    assert duration < 0.6


@pytest.mark.parametrize(
    "reading",
    [
        lambda t: ((0.0, 0.0), 0.0),
        lambda t: ((20.0, 0.0), 0.02),
        lambda t: ((20.0, 20.0) if int(t / 0.05) % 2 else (20.0, 0.0), 0.02),
        lambda t: ((20.0, 20.0), 0.0),  # the fingers press on each other
    ],
)
def test_without_lasting_force_on_both_fingers_there_is_no_grip(reading):
    failure, _ = close(reading)
    assert failure is not None
    assert failure.status is SkillStatus.FAILED


@pytest.mark.parametrize(("opening", "held"), [(0.0, False), (0.02, True), (None, True)])
def test_fingers_that_press_on_each_other_hold_nothing(opening, held):
    """The fingers press after a stop, or after a restart of the program; a hand may not measure its opening."""
    hand = FakeHand()
    arm = ArmController(PANDA, hand.motion)
    arm.observe(hand.observe((10.0, 10.0), opening))
    assert arm.detect_grasp("cube") == held
    assert (arm.holding is not None) == held
    arm.holding = None
    assert arm.resume_grasp("cube", 0.0, 10.0) == held


@pytest.mark.parametrize(("forces", "held"), [((10.0, 10.0), True), ((10.0, 0.0), False)])
def test_a_recorded_grasp_is_monitored_or_dropped(forces, held):
    """As after a skill that ended between the record of the grasp and the judgement of the micro-lift."""
    hand = FakeHand()
    arm = ArmController(PANDA, hand.motion)
    arm.observe(hand.observe(forces))
    arm.record_grasp(arm.find_object("cube"))
    arm.check_holding()
    assert (arm.holding is not None, arm.load_monitor.name) == ((True, "cube") if held else (False, ""))


def test_a_declared_limit_lowers_the_bound_of_the_contract():
    cube = SceneObject(name="cube", role="object", shape=Box((0.02, 0.02, 0.02)), pose=Pose((0.5, 0.0, 0.02)))
    assert max_grip_force(PANDA, cube, 60.0) == 60.0
    assert max_grip_force(PANDA, cube, 5.0) == 5.0
    glass = SceneObject(name="glass", role="object", shape=cube.shape, pose=cube.pose, fragile_limit=15.0)
    assert max_grip_force(PANDA, glass, 60.0) == pytest.approx(12.0)


def grip_forces(cell):
    """Every grip force that the cell commands, by phase, with the largest true contact force on the glass [N]."""
    forces, write = {}, cell.plant.write

    def record(command):
        forces.setdefault(cell.executor.loop.phase, []).append(command.force)
        write(command)

    cell.plant.write = record
    return forces


GLASS = {"object": "clear_glass", "clearance": 0.15, "opening": 0.08, "finger_axis": "along"}
NEEDED = {0: 0.5, 2: 11.5}
"""Force [N] that holds the dry glass of scene 0 and the full, wet one of scene 2 (about weight / 2 / friction)."""


@pytest.mark.parametrize(("seed", "force"), [(0, 60.0), pytest.param(2, 60.0, marks=pytest.mark.slow), (0, 5.0)])
def test_the_grip_force_is_a_multiple_of_that_which_holds_and_breaks_no_glass(seed, force):
    cell = SkillCell("fragile_ii", seed=seed, noise=PerceptionNoise())
    forces = grip_forces(cell)
    axis = "across" if seed % 2 else "along"
    outcome = cell.run(grasp(**GLASS | {"force": force, "finger_axis": axis}), ("hold", {"duration": 0.5}))
    assert outcome.kind == "succeeded", outcome.reason
    assert not [one for one in cell.monitor.violations() if one.kind == "force_fragile"]
    most = max(forces["lift"])
    assert most <= force
    least = PANDA.gripper.force_min.value
    assert most <= max(GRIP_RESERVE * least, 1.05 * GRIP_FORCE_STEP * GRIP_RESERVE * NEEDED[seed])
    assert forces["close"][0] == least


def block_lifts(monkeypatch, highest):
    """Let every lift above the tool height `highest` [m] end there without progress."""

    def blocked(arm, height, phase, speed, **options):
        why = yield from move_to_height(arm, min(height, highest), phase, speed, **options)
        if why is None and phase == "lift" and height > highest:
            return SkillResult(SkillStatus.TAKEN_OVER, "lift: no progress", FailureCause.NO_PROGRESS)
        return why

    monkeypatch.setattr(grasp_skill, "move_to_height", blocked)


@pytest.mark.parametrize(("free", "kind"), [(0.035, "taken_over"), (0.06, "succeeded")])
def test_a_blocked_lift_counts_if_the_load_is_clear_of_its_support(monkeypatch, free, kind):
    cell = SkillCell(noise=PerceptionNoise())
    block_lifts(monkeypatch, cell.plant.true_pose("red_cube").position[2] + free)
    outcome = cell.run(grasp(), place())
    assert outcome.kind == kind, outcome.reason
    assert cell.monitor.violations() == ()


def test_a_glass_that_slips_at_the_largest_force_is_left_standing_with_an_empty_hand():
    cell = SkillCell("fragile_ii", seed=2, noise=PerceptionNoise())
    outcome = cell.run(grasp(**GLASS | {"force": 5.0}))
    assert outcome.kind == "failed"
    assert "slips" in outcome.reason
    assert cell.executor.held_object is None
    assert cell.plant.true_pose("clear_glass").position[2] == pytest.approx(0.045, abs=0.002)
    assert cell.monitor.violations() == ()


# --- loss and slip ----------------------------------------------------------------------------------------------------


def watch(hand):
    """A monitor of the cube in `hand`, gripped with 8 N."""
    monitor, first = LoadMonitor(), hand.observe((8.0, 8.0))
    monitor.watch(first.scene.find("cube"), np.zeros(3), first)
    return monitor


def detect(hand, monitor, reading, duration=1.0):
    """The first event within `duration` [s] and its delay, if `reading(t)` gives finger forces [N] and opening [m]."""
    start = hand.now
    while hand.now - start < duration:
        if event := monitor.update(hand.observe(*reading(hand.now - start))):
            return event, hand.now - start
    return None, duration


@pytest.mark.parametrize(
    "reading",
    [
        lambda t: ((0.0, 0.0), 0.02),
        lambda t: ((8.0, 0.0), 0.02),
        lambda t: ((8.0, 8.0), max(0.0, 0.02 - 0.05 * t)),  # removed: the fingers close quickly
    ],
)
def test_a_lost_load_is_detected_in_time(reading):
    hand = FakeHand()
    event, delay = detect(hand, watch(hand), reading)
    assert event is not None
    assert event.slip == 0.0
    assert delay <= DETECTION_TIME


@pytest.mark.parametrize("error", [0.0, 0.009])
def test_a_slip_is_detected_in_time_and_not_taken_for_a_loss(error):
    hand = FakeHand(error)
    monitor = watch(hand)
    hand.shift = np.array([0.0, 0.0, -0.03])
    event, delay = detect(hand, monitor, lambda t: ((8.0, 8.0), 0.02))
    assert event is not None
    assert event.slip == pytest.approx(0.03)
    assert "still held" in event.describe()
    assert delay <= DETECTION_TIME


@pytest.mark.parametrize(
    "reading",
    [
        lambda t: ((8.0, 8.0), 0.02),
        lambda t: ((8.0, 8.0), 0.02 - 0.0017 * t),  # turns slowly between the fingers
        lambda t: ((8.0, 8.0 if int(t / 0.03) % 3 else 0.0), 0.02),  # vibrates
    ],
)
def test_a_load_that_is_held_causes_no_event(reading):
    hand = FakeHand(0.009)
    monitor = watch(hand)
    hand.shift = np.array([0.0, 0.012, -0.012])  # within the errors of both measurements
    assert detect(hand, monitor, reading, duration=3.0)[0] is None


def remove_at(cell, name, when):
    """Take the object `name` down out of the fingers once `when(loop)` is true; returns the list of these times [s]."""
    advance, address, taken = cell.world.advance, cell.plant.model.joint(name).qposadr[0], []

    def step():
        loop = cell.executor.loop
        if not taken and loop.held_object and when(loop):
            cell.plant.data.qpos[address + 2] -= 0.06
            taken.append(loop.state.stamp)
        advance()

    cell.world.advance = step
    return taken


ABOVE_BOWL = {"target": "blue_bowl", "speed": 0.2, "clearance": 0.2, "route": "direct", "wait": "none"}
CARRYING = [
    ("hold", ("hold", {"duration": 2.0})),
    ("carry", place()),
    ("approach", ("move_to", ABOVE_BOWL)),
    ("return", ("home", {"speed": 0.2})),
]


@pytest.mark.parametrize(("phase", "action"), CARRYING)
def test_every_skill_that_carries_fails_in_time_when_the_load_is_removed(phase, action):
    cell = SkillCell(noise=PerceptionNoise())
    taken = remove_at(cell, "red_cube", lambda loop: loop.phase == phase)
    outcome = cell.run(grasp(), action)
    assert outcome.kind == "failed", outcome.reason
    assert f"{phase}: red_cube was lost" in outcome.reason
    assert outcome.actions[1].ended - taken[0] <= DETECTION_TIME
    assert cell.executor.held_object is None


@pytest.mark.parametrize("action", [("release", {"speed": 0.2}), place()])
def test_a_hand_that_does_not_open_still_holds_its_load(action):
    cell = SkillCell(noise=PerceptionNoise())
    write = cell.plant.write
    cell.plant.write = lambda command: write(
        replace(command, opening=0.0) if cell.executor.loop.phase == "open" else command
    )
    outcome = cell.run(grasp(), action)
    assert (outcome.kind, outcome.failure_cause) == ("failed", FailureCause.GOAL_MISSED)
    assert "still press on red_cube" in outcome.reason
    assert cell.executor.held_object == "red_cube"
    assert cell.executor.loop.controller.load_monitor.name == "red_cube"
    cell.executor.hold(0.5)
    assert cell.executor.held_object == "red_cube"
