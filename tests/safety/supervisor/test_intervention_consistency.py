"""The control that is written answers the nominal that was asked for: δ as told is δ as measured, on every body."""

import msgspec
import numpy as np
import pytest

from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import obstacles_from_scene
from dualbrain.safety.supervisor.controller import SafetyController
from dualbrain.safety.supervisor.intervention import DELTA_TOLERANCE, compute_delta, is_consistent
from dualbrain.simulation.scenes.generators.catalogue import open_scene

BODIES = ("panda", "ur5e", "fr3", "base")


def wandering(name, rng, steps=600):
    """(nominal, answer) of a filter whose arm is thrown about, at nominals from slow to far beyond the limits."""
    robot_model = load_robot(name)
    safety = SafetyFilter(robot_model)
    safety.observe(obstacles_from_scene(scene_from_spec(open_scene("1", name)), known=(), held=None), 0.0)
    q, v, nominal = np.array(robot_model.home), np.zeros(robot_model.n), np.zeros(robot_model.n)
    for k in range(steps):
        if k % 40 == 0:
            nominal = rng.normal(size=robot_model.n) * rng.choice([0.1, 0.5, 2.0, 10.0])
        answer = safety.filter(
            RobotState(
                stamp=k * 1e-3, sequence=k, q=q, v=v, opening=0.04, finger_forces=(0.0, 0.0), drive_enabled=True
            ),
            nominal,
            k * 1e-3,
        )
        yield nominal, answer
        v = answer.u
        q = q if robot_model.is_mobile else q + v * robot_model.period


@pytest.mark.parametrize("name", BODIES)
def test_every_answer_is_one_to_its_question_far_within_the_tolerance(name, rng):
    for nominal, answer in wandering(name, rng):
        assert is_consistent(answer, nominal)
        assert abs(compute_delta(answer, answer.u, nominal) - answer.delta) < 1e-2 * DELTA_TOLERANCE


def test_an_answer_to_an_earlier_question_is_found_out(rng):
    """By its control alone (δ is fresh) as by the whole of it (δ is as old), once either should have changed."""
    log = list(wandering("panda", rng))
    pairs = [(old, nominal, fresh) for (_, old), (nominal, fresh) in zip(log, log[80:], strict=False)]
    late = [pair for pair in pairs if compute_delta(pair[2], pair[0].u, pair[2].u) > 0.01 and pair[2].delta < 1.9]
    caught = sum(not is_consistent(msgspec.structs.replace(fresh, u=old.u), nominal) for old, nominal, fresh in late)
    assert len(late) > 200
    assert caught > 0.95 * len(late)
    assert sum(not is_consistent(old, nominal) for old, nominal, _ in late) > 0.95 * len(late)


def test_a_nominal_that_is_no_number_is_left_to_the_filter(rng):
    _, answer = next(wandering("panda", rng))
    assert is_consistent(answer, np.full(7, np.nan))


def test_the_spine_writes_braking_in_the_place_of_an_old_answer(rng):
    robot_model = load_robot("panda")
    spine, kept = SafetyController(SafetyFilter(robot_model)), []
    usual = spine.safety.filter

    def hanging(state, nominal, now):
        kept.append(usual(state, nominal, now))
        return kept[min(len(kept) - 1, 60)]

    spine.safety.filter = hanging
    q, wanted = np.array(robot_model.home), np.zeros(7)
    for k in range(200):
        now = k * 1e-3
        wanted[0] = 0.4 * min(1.0, k / 100)
        state = RobotState(
            stamp=now, sequence=k, q=q, v=np.zeros(7), opening=0.04, finger_forces=(0.0, 0.0), drive_enabled=True
        )
        order = spine.decide(state, now)
        written = spine.control(state, wanted.copy(), now)
        q = q + written.u * robot_model.period
        if order.check == "control_bad":
            break
    assert order.check == "control_bad"
    assert k < 70, "found within a few periods"
    assert spine.scale_applied < 0.0
    assert abs(written.u[0]) < abs(kept[60].u[0]), "it brakes"


HOLDS = {
    "answer": lambda answer: answer,
    "control": lambda answer: answer.u,
    "view": lambda answer: answer.u[2:],
    "buffer": lambda answer: memoryview(answer.u),
    "transposed": lambda answer: answer.u.reshape(-1, 1).T,
}


@pytest.mark.parametrize("hold", HOLDS)
def test_an_answer_that_somebody_holds_never_changes(hold, panda, rng):
    """Every third is held, in whatever way; the others are let go, and their arrays may come again."""
    safety, held = SafetyFilter(panda), []
    for k in range(90):
        answer = safety(panda.home, np.zeros(7), rng.normal(size=7))
        if k % 3 == 0:
            held.append((HOLDS[hold](answer), answer.u.copy()))
    for kept, was in held:
        got = np.asarray(kept.u if hold == "answer" else kept).ravel()
        np.testing.assert_array_equal(got, was[-len(got) :])
    assert len({tuple(was) for _, was in held}) == len(held)


def test_whatever_was_done_to_a_control_the_next_is_an_array_to_write_into(panda, rng):
    safety = SafetyFilter(panda)
    for spoil in (
        lambda u: u.setflags(write=False),
        lambda u: setattr(u, "shape", (7, 1)),
        lambda u: setattr(u, "shape", (1, 7)),
        lambda u: setattr(u, "dtype", np.int64),
        lambda u: setattr(u, "dtype", ">f8"),
        lambda u: u.resize(3, refcheck=False),
    ):
        for _ in range(4):
            spoil(safety(panda.home, np.zeros(7), rng.normal(size=7)).u)
            u = safety(panda.home, np.zeros(7), np.zeros(7)).u
            assert (u.shape, u.dtype, u.flags.writeable, u.dtype.isnative) == ((7,), np.float64, True, True)
            assert np.all(np.isfinite(u))
