"""A killed host: the motion after the kill, and the counts of the page."""

import numpy as np
import pytest

from dualbrain.robots.loader import load_robot
from dualbrain.safety.target.messages import CYCLE_REPLY, Message, parse_cycle_reply
from experiments.robots.targets.host_kills import LAST_CYCLE_RISE, HostKills, run_kill
from experiments.robots.targets.killed_host import SharedState, _motion

PANDA = load_robot("panda")


def reply(u):
    return parse_cycle_reply(CYCLE_REPLY.pack(0, *[u] * 8, *[0.0] * 4, *[0] * 12))


def test_the_state_survives_a_torn_write():
    shared = SharedState(2)
    shared.write(1, np.array([1.0, 2.0]), np.array([3.0, 4.0]))
    other_slot = 8
    shared._memory[other_slot : other_slot + 32] = b"x" * 32  # a write that did not end
    count, q, u = shared.read()
    assert (count, q.tolist(), u.tolist()) == (1, [1.0, 2.0], [3.0, 4.0])


def test_the_last_control_acts_until_the_target_brakes():
    replies = [(Message.OUTPUT, reply(0.3)), (Message.OUTPUT, reply(0.1))]
    path, controls = _motion(PANDA, np.zeros(7), np.full(7, 0.5), replies)
    assert controls[:, 0].tolist() == pytest.approx([0.5] * 50 + [0.3, 0.1])
    assert path[-1, 0] == pytest.approx(1e-3 * (50 * 0.5 + 0.4))
    unread = [(Message.CYCLE_REPLY, reply(0.4)), *replies]
    assert _motion(PANDA, np.zeros(7), np.full(7, 0.5), unread)[1][0, 0] == pytest.approx(0.4)


@pytest.mark.realtime
def test_a_killed_host_leaves_an_arm_at_rest():
    row = run_kill("an386", 3)
    assert row["cycles"] > 0
    assert not row["stayed_on"]
    assert (row["rise"], row["last_speed"]) == (0.0, 0.0)
    assert row["h"] > 0.0


def test_the_table_counts_every_fault():
    good = {
        "speed": 1.0,
        "was_on": True,
        "stayed_on": False,
        "off_s": 0.16,
        "rise": 0.0,
        "h": 0.01,
        "h_scene": 0.02,
        "cycles": 9,
    }
    bad = [good, good | {"stayed_on": True}, good | {"rise": 0.1}, good | {"h": -1e-4}, good | {"was_on": False}]
    row = {"unit": 0, "board": "an386"} | {name: [one[name] for one in bad] for name in good}
    line = HostKills().report([row])[2]
    assert line == "| Cortex-M4F (an386) | 5 | 4 | 0.160, 0.160, 0.160 | 1 | 1, 0.1000 | 1 | 20.00 |"


def test_the_rise_of_one_cycle_is_that_of_the_robot():
    assert max(joint.acceleration.value for joint in PANDA.joints) * PANDA.period == pytest.approx(LAST_CYCLE_RISE)
