"""Pauses of the operator do not count in the time limits of an arm's routines."""

from dataclasses import replace

import msgspec
import pytest

from dualbrain.skills.arm import grasp
from dualbrain.skills.arm.controller import (
    CLOSING_TIMEOUT,
    LEAVING_TIMEOUT,
    PERSON_WAIT_TIMEOUT,
    YIELDED,
    ArmController,
)
from dualbrain.skills.arm.grasp import MAX_OBSERVATION_TIME
from dualbrain.skills.arm.waypoints import move_to_height, wait_for_people
from tests.skills.arm.test_blocked_waypoints import BODY
from tests.skills.arm.test_grip import PANDA, FakeHand
from tests.skills.arm.test_leaving_objects import CellWithCube
from tests.skills.arm.test_waiting_for_people import CellWithPerson

PAUSE = PERSON_WAIT_TIMEOUT + 5.0
"""Duration of a pause [s], longer than every time limit of the routines."""


def pausing(cell, routine, *, after=0.1, due=lambda: True):
    """`routine` with a pause in the first tick after `after` [s] in which `due()` is true."""
    while True:
        try:
            nominal = next(routine)
        except StopIteration as end:
            return end.value
        if cell.paused == 0.0 and cell.now > after and due():
            cell.pause(PAUSE)
        yield nominal


def carry_out_with_pause(hand, routine, reading):
    """The result of a gripper routine; `reading(t)` are forces [N] and opening [m] at the active time t [s]."""
    while True:
        try:
            next(routine)
        except StopIteration as end:
            return end.value
        if hand.paused == 0.0 and hand.now > 0.1:
            hand.now, hand.paused = hand.now + PAUSE, PAUSE
        hand.arm.observe(hand.observe(*reading(hand.now - hand.paused)))


@pytest.fixture
def hand():
    hand = FakeHand()
    hand.arm = ArmController(PANDA, hand.motion)
    hand.arm.observe(hand.observe((0.0, 0.0), 0.02))
    return hand


def test_fingers_that_close_around_a_pause_grip(hand):
    assert PAUSE > CLOSING_TIMEOUT
    closing = hand.arm.close_gripper(5.0)
    failure = carry_out_with_pause(hand, closing, lambda t: ((9.0, 9.0), 0.02) if t > 0.5 else ((0.0, 0.0), 0.03))
    assert failure is None
    assert hand.now - hand.paused < 0.7


def test_fingers_that_open_around_a_pause_are_open_at_the_end(hand):
    opening = hand.arm.open_gripper(0.04)
    carry_out_with_pause(hand, opening, lambda t: ((0.0, 0.0), 0.04 if t > 0.8 else 0.02))
    assert 0.8 < hand.now - hand.paused < 1.2


def test_a_wait_for_a_person_does_not_count_a_pause():
    cell = CellWithPerson(PAUSE + 2.0)
    here = cell.controller.current_goal()
    routine = wait_for_people(cell.controller, here, cell.spot, 2.0, "carry", 0.2)
    assert cell.carry_out(pausing(cell, routine), limit=PAUSE + 10.0) is None
    assert cell.now == pytest.approx(PAUSE + 2.0, abs=0.5)


def test_an_arm_that_yields_does_not_count_a_pause():
    cell = CellWithCube(person_until=PAUSE + 1.0)
    routine = cell.controller.avoid_person("approach", 0.3)
    assert cell.carry_out(pausing(cell, routine), limit=PAUSE + 10.0) is YIELDED
    assert cell.now == pytest.approx(PAUSE + 1.0, abs=0.1)


def test_a_hand_that_leaves_an_object_does_not_count_a_pause():
    cell = CellWithCube(person_until=0.0)
    routine, fixed, ticks = cell.controller.avoid_person("descend", 0.3), cell.state, 0
    for _ in routine:
        ticks += 1
        cell.now += BODY.period
        if ticks == 100:
            cell.pause(PAUSE)
        cell.state = replace(fixed, stamp=cell.now, sequence=ticks)
        cell.observe()
    assert ticks * BODY.period == pytest.approx(LEAVING_TIMEOUT, abs=0.01)


class CellWithSlippingCube(CellWithCube):
    """Fingers that press on a cube, which stays where it is while they rise; it is perceived every 33 ms."""

    def __init__(self):
        super().__init__()
        self.state = replace(self.state, opening=0.034, finger_forces=(5.0, 5.0))
        self.observe()

    def observe(self):
        stamp = 0.033 * int(self.now / 0.033)
        cube = msgspec.structs.replace(self.scene.find("cube"), stamp=stamp)
        table = self.scene.find("table")
        self.scene = msgspec.structs.replace(self.scene, stamp=stamp, objects=(table, cube))
        super().observe()


def test_the_observation_of_a_micro_lift_does_not_count_a_pause(monkeypatch):
    """Without an observation the finger forces alone would decide, and the cube would count as held."""
    cell, lifted = CellWithSlippingCube(), []

    def lift(*arguments, **options):
        why = yield from move_to_height(*arguments, **options)
        lifted.append(cell.now)
        return why

    monkeypatch.setattr(grasp, "move_to_height", lift)
    routine = pausing(cell, grasp._micro_lift(cell.controller, "cube"), due=lambda: bool(lifted))
    assert cell.carry_out(routine, limit=PAUSE + 10.0) is None
    assert cell.controller.holding is None
    assert cell.now - PAUSE - lifted[0] < MAX_OBSERVATION_TIME
