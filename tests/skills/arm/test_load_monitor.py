"""The load monitor by itself: a tool that moves, measurements that are late, and the state after an event."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, Pose
from dualbrain.records import FailureCause, Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.skills.arm.load_monitor import (
    DETECTION_TIME,
    LOSS_TIME,
    MAX_AGE,
    MAX_CLOSING,
    LoadMonitor,
    offset_in_tool,
)
from dualbrain.skills.skill import Observation

STATE = home_state(load_robot("panda"))
TURNED = quaternion_to_matrix((0.5, 0.5, 0.5, 0.5))
"""Each axis of the tool is another axis of the world: the matrix is not symmetric."""
OFFSET = np.array([0.01, -0.02, 0.03])
PRESSING, LOOSE = (8.0, 8.0), (8.0, 0.0)
PERIOD = 0.02
SLIPPED = np.array([0.0, 0.0, -0.05])


def observe(
    now, tool=(0.0, 0.0, 0.0), *, slip=(0.0, 0.0, 0.0), seen=None, seen_tool=None, forces=PRESSING, opening=0.02
):
    """An observation at `now` [s] with the tool at `tool`; the cube was seen at the time `seen` from `seen_tool`."""
    stamp = now if seen is None else seen
    position = np.array(tool if seen_tool is None else seen_tool) + TURNED @ OFFSET + np.array(slip)
    cube = SceneObject(
        name="cube",
        role="object",
        shape=Box((0.02, 0.02, 0.02)),
        pose=Pose(tuple(position.tolist())),
        error=0.002,
        stamp=stamp,
    )
    return Observation(
        state=replace(STATE, stamp=now, opening=opening, finger_forces=forces),
        scene=Scene(robot="panda", stamp=stamp, version=1, objects=(cube,)),
        now=now,
        tool=SimpleNamespace(position=np.array(tool), rotation=TURNED),
    )


def monitor(start=0.0, **first):
    """A monitor of the cube from `start` [s]."""
    one, seen = LoadMonitor(), observe(start, **first)
    cube = seen.scene.find("cube")
    one.watch(cube, offset_in_tool(cube, seen.tool.position, seen.tool.rotation), seen)
    return one


def test_the_offset_is_in_the_frame_of_the_tool():
    seen = observe(0.0, (0.3, -0.2, 0.5))
    assert offset_in_tool(seen.scene.find("cube"), seen.tool.position, seen.tool.rotation) == pytest.approx(OFFSET)


def test_a_load_that_moves_with_the_tool_causes_no_event():
    one = monitor()
    for tick in range(1, 50):
        assert one.update(observe(PERIOD * tick, (0.01 * tick, 0.0, 0.02 * tick))) is None


def test_a_late_measurement_is_compared_with_the_pose_of_its_time():
    """Perception is five ticks late while the tool moves by 2 cm a tick."""
    one = monitor()
    for tick in range(1, 40):
        late = max(0, tick - 5)
        seen = {"seen": PERIOD * late, "seen_tool": (0.02 * late, 0.0, 0.0)}
        assert one.update(observe(PERIOD * tick, (0.02 * tick, 0.0, 0.0), **seen)) is None


def test_a_measurement_older_than_the_stored_poses_is_not_compared():
    one = monitor()
    for tick in range(1, 40):
        now = PERIOD * tick
        old = {"seen": max(0.001, now - 2.0 * MAX_AGE), "seen_tool": (0.0, 0.0, 0.0)}
        if now > 2.0 * MAX_AGE:
            assert one.update(observe(now, (0.02 * tick, 0.0, 0.0), **old)) is None
        else:
            assert one.update(observe(now, (0.02 * tick, 0.0, 0.0), seen=0.0)) is None


def test_a_slip_without_force_on_both_fingers_is_a_loss_at_once():
    one = monitor()
    event = one.update(observe(0.5 * LOSS_TIME, slip=SLIPPED, forces=LOOSE))
    assert event is not None
    assert (event.slip, event.cause) == (0.0, FailureCause.LOAD_LOST)


def test_a_slip_is_reported_once_and_the_next_one_from_there():
    one = monitor()
    first = one.update(observe(0.02, slip=SLIPPED))
    assert first is not None
    assert first.slip == pytest.approx(0.05)
    assert first.cause is FailureCause.LOAD_SLIPPED
    assert one.update(observe(0.04, slip=SLIPPED)) is None
    second = one.update(observe(0.06, slip=1.6 * SLIPPED))
    assert second is not None
    assert second.slip == pytest.approx(0.03)


def test_a_lost_load_is_reported_once_and_not_monitored_further():
    one = monitor()
    events = [one.update(observe(PERIOD * tick, forces=LOOSE)) for tick in range(1, 40)]
    assert sum(event is not None for event in events) == 1
    assert one.name == ""


@pytest.mark.parametrize(("closed", "lost"), [(0.0, True), (0.001, False)])
def test_a_thin_load_is_lost_once_the_fingers_press_on_each_other(closed, lost):
    """The fingers close by less than `MAX_CLOSING`, and both press all the time."""
    one = monitor(opening=0.003)
    events = [one.update(observe(PERIOD * tick, opening=0.003 if tick < 5 else closed)) for tick in range(1, 40)]
    found = [(tick, event) for tick, event in enumerate(events, start=1) if event is not None]
    assert len(found) == lost
    for tick, event in found:
        assert event.cause is FailureCause.LOAD_LOST
        assert PERIOD * (tick - 5) <= DETECTION_TIME


def test_a_new_load_is_not_compared_with_the_opening_of_the_one_before():
    one = monitor(opening=0.04)
    assert one.update(observe(0.02, opening=0.04)) is None
    second = observe(0.04, opening=0.04 - 3.0 * MAX_CLOSING)
    one.watch(second.scene.find("cube"), OFFSET, second)
    assert one.update(observe(0.06, opening=0.04 - 3.0 * MAX_CLOSING)) is None


def test_poses_in_another_frame_are_not_compared():
    """The frame of the observations moves with a base that has driven; a measurement from before is not compared."""
    one = monitor()
    assert one.update(observe(0.02)) is None
    one.forget_motion()
    there = (1.0, 0.0, 0.0)
    assert one.update(observe(0.04, there, seen=0.025, seen_tool=there)) is None
    assert one.update(observe(0.06, there)) is None
    assert one.update(observe(0.08, there, slip=SLIPPED)) is not None


def test_without_a_load_nothing_is_reported():
    one = monitor()
    one.forget()
    assert one.update(observe(1.0, slip=SLIPPED, forces=LOOSE)) is None


@pytest.mark.parametrize("forces", [PRESSING, LOOSE])
def test_an_opening_that_is_not_known_for_a_moment_is_no_closed_hand(forces):
    """The driver of a hand that could not be read states no opening."""
    one = monitor()
    events = [one.update(observe(PERIOD * tick)) for tick in range(1, 10)]
    events.append(one.update(observe(PERIOD * 10, opening=None, forces=forces)))
    events += [one.update(observe(PERIOD * tick)) for tick in range(11, 40)]
    assert not any(events)
