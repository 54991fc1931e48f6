"""The moving forearm: a continuous path, a small following error, and a force that never exceeds its limit."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.moving_person import PERSON_ACCELERATION, person_path
from dualbrain.simulation.scenes.scene_spec import MovingPerson, SceneSpec
from tests.simulation.scripted_hand import HOME, PANDA, make_plant, wait

movers = st.builds(
    MovingPerson,
    start=st.just((0.7, -0.5, 0.17)),
    end=st.tuples(st.just(0.7), st.floats(-0.4, 0.5), st.just(0.17)),
    speed=st.floats(0.05, 0.6),
    pause=st.floats(0.0, 3.0),
    phase=st.floats(0.0, 20.0),
)


@given(movers, st.floats(0.0, 60.0))
@settings(deadline=None)
def test_the_path_is_continuous_bounded_and_its_rate_is_its_derivative(mover, t):
    path = person_path(mover)
    distance, rate = path.state_at(t)
    later, rate_later = path.state_at(t + 1e-4)
    assert -1e-9 <= distance <= path.length + 1e-9
    assert abs(rate) <= mover.speed + 1e-9
    assert abs(later - distance - 1e-4 * 0.5 * (rate + rate_later)) < 1e-6
    assert abs(rate_later - rate) <= 2 * PERSON_ACCELERATION * 1e-4 + 1e-9
    assert np.allclose(path.state_at(t + path.cycle_duration), (distance, rate), atol=1e-6)


def crossing(**changes):
    mover = MovingPerson(start=(0.78, -0.4, 0.2), end=(0.78, 0.4, 0.2), speed=0.2, pause=0.1, phase=0.0, **changes)
    return Plant(SceneSpec(robot="panda", family="forearm", seed=0, objects=(), places=(), mover=mover), PANDA)


def test_the_forearm_follows_its_path():
    p = crossing()
    path, errors = person_path(p.spec.mover), []
    for _ in range(2500):
        p.advance()
        distance, _ = path.state_at(p.now)
        errors.append(np.linalg.norm(p.true_pose("forearm").position - (path.start + distance * path.direction)))
    assert max(errors) < 3e-3


def test_a_blocked_forearm_pushes_with_a_bounded_force():
    """The robot blocks the path with its brakes engaged; the force stays below 150 N."""
    p = crossing()
    p.set_configuration(np.array([0.0, 0.65, 0.0, -1.9, 0.0, 2.5, 0.785]))
    p.stop()
    arm, forces = p.read().q, []
    drives = [p.model.actuator(f"forearm_{axis}").id for axis in "xyz"]

    def record_force():
        forces.append(np.linalg.norm(p.data.actuator_force[drives]))

    wait(p, 4.0, each=record_force)
    assert p.data.ncon > 0
    assert p.true_pose("forearm").position[1] < 0.1, "the forearm did not pass the arm"
    assert 60.0 < max(forces) <= 150.0 + 1e-6
    assert np.abs(p.read().q - arm).max() < 0.02


def test_gravity_does_not_pull_the_forearm():
    p = make_plant("forearm", 1)
    start = p.true_pose("forearm").position[2]
    wait(p, 0.5)
    assert abs(p.true_pose("forearm").position[2] - start) < 1e-3
    assert np.allclose(p.read().q, HOME, atol=1e-6)
