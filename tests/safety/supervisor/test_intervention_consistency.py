"""Consistency of a filter result with its input: the reported δ is the recomputed δ, on every robot."""

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

ROBOTS = ("panda", "ur5e", "fr3", "base")


def random_steps(name, rng, steps=600):
    """Pairs (nominal, result) of a filter with random nominal controls, from slow to far beyond the limits."""
    robot_model = load_robot(name)
    safety = SafetyFilter(robot_model)
    safety.observe(obstacles_from_scene(scene_from_spec(open_scene("1", name)), known=(), held=None), 0.0)
    q, v, nominal = np.array(robot_model.home), np.zeros(robot_model.n), np.zeros(robot_model.n)
    for k in range(steps):
        if k % 40 == 0:
            nominal = rng.normal(size=robot_model.n) * rng.choice([0.1, 0.5, 2.0, 10.0])
        result = safety.filter(
            RobotState(
                stamp=k * 1e-3, sequence=k, q=q, v=v, opening=0.04, finger_forces=(0.0, 0.0), drive_enabled=True
            ),
            nominal,
            k * 1e-3,
        )
        yield nominal, result
        v = result.u
        q = q if robot_model.is_mobile else q + v * robot_model.period


@pytest.mark.parametrize("name", ROBOTS)
def test_every_result_is_consistent_with_its_input_far_within_the_tolerance(name, rng):
    for nominal, result in random_steps(name, rng):
        assert is_consistent(result, nominal)
        assert abs(compute_delta(result, result.u, nominal) - result.delta) < 1e-2 * DELTA_TOLERANCE


def test_a_result_of_an_earlier_input_is_detected(rng):
    """An old control with a new δ and a whole old result are both detected as soon as either should have changed."""
    log = list(random_steps("panda", rng))
    pairs = [(old, nominal, fresh) for (_, old), (nominal, fresh) in zip(log, log[80:], strict=False)]
    late = [pair for pair in pairs if compute_delta(pair[2], pair[0].u, pair[2].u) > 0.01 and pair[2].delta < 1.9]
    caught = sum(not is_consistent(msgspec.structs.replace(fresh, u=old.u), nominal) for old, nominal, fresh in late)
    assert len(late) > 200
    assert caught > 0.95 * len(late)
    assert sum(not is_consistent(old, nominal) for old, nominal, _ in late) > 0.95 * len(late)


def test_a_nominal_that_is_not_a_number_is_left_to_the_filter(rng):
    _, result = next(random_steps("panda", rng))
    assert is_consistent(result, np.full(7, np.nan))


def test_the_safety_controller_brakes_instead_of_writing_an_old_result(rng):
    robot_model = load_robot("panda")
    controller, kept = SafetyController(SafetyFilter(robot_model)), []
    usual = controller.safety.filter

    def hanging(state, nominal, now):
        kept.append(usual(state, nominal, now))
        return kept[min(len(kept) - 1, 60)]

    controller.safety.filter = hanging
    q, nominal = np.array(robot_model.home), np.zeros(7)
    for k in range(200):
        now = k * 1e-3
        nominal[0] = 0.4 * min(1.0, k / 100)
        state = RobotState(
            stamp=now, sequence=k, q=q, v=np.zeros(7), opening=0.04, finger_forces=(0.0, 0.0), drive_enabled=True
        )
        decision = controller.decide(state, now)
        written = controller.control(state, nominal.copy(), now)
        q = q + written.u * robot_model.period
        if decision.check == "control_bad":
            break
    assert decision.check == "control_bad"
    assert k < 70, "found within a few periods"
    assert controller.scale_applied < 0.0
    assert abs(written.u[0]) < abs(kept[60].u[0]), "it brakes"


HOLDS = {
    "result": lambda result: result,
    "control": lambda result: result.u,
    "view": lambda result: result.u[2:],
    "buffer": lambda result: memoryview(result.u),
    "transposed": lambda result: result.u.reshape(-1, 1).T,
}


@pytest.mark.parametrize("hold", HOLDS)
def test_a_result_that_is_referenced_never_changes(hold, panda, rng):
    """Every third result stays referenced, in one of several ways; the arrays of the others may be reused."""
    safety, held = SafetyFilter(panda), []
    for k in range(90):
        result = safety(panda.home, np.zeros(7), rng.normal(size=7))
        if k % 3 == 0:
            held.append((HOLDS[hold](result), result.u.copy()))
    for kept, was in held:
        got = np.asarray(kept.u if hold == "result" else kept).ravel()
        np.testing.assert_array_equal(got, was[-len(got) :])
    assert len({tuple(was) for _, was in held}) == len(held)


def test_the_next_control_is_a_normal_array_after_any_change_of_the_last_one(panda, rng):
    safety = SafetyFilter(panda)
    for change in (
        lambda u: u.setflags(write=False),
        lambda u: setattr(u, "shape", (7, 1)),
        lambda u: setattr(u, "shape", (1, 7)),
        lambda u: setattr(u, "dtype", np.int64),
        lambda u: setattr(u, "dtype", ">f8"),
        lambda u: u.resize(3, refcheck=False),
    ):
        for _ in range(4):
            change(safety(panda.home, np.zeros(7), rng.normal(size=7)).u)
            u = safety(panda.home, np.zeros(7), np.zeros(7)).u
            assert (u.shape, u.dtype, u.flags.writeable, u.dtype.isnative) == ((7,), np.float64, True, True)
            assert np.all(np.isfinite(u))
