"""Inputs of the filter: any sequence of numbers counts as an array, and other shapes raise `ConfigurationError`."""

from dataclasses import replace

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.errors import ConfigurationError
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import ConstraintRow, Obstacle, SafetyFilter

ROBOTS = ("panda", "base", "mobile_panda")
BALL = Obstacle("ball", Sphere(0.1), Pose((1.2, 0.0, 0.4)), known=True)
SEQUENCES = {
    "list": np.ndarray.tolist,
    "tuple": tuple,
    "float32": np.float32,
    "strided": lambda a: np.repeat(a, 2)[::2],
}


class OneRow:
    """A Python barrier that computes with the state as an array."""

    def rows(self, state, jacobian):
        a = jacobian[0] + 0.0 * state.v
        return (ConstraintRow(name="x", a=tuple(a), b=-1.0, h=float(state.q.sum())),)


def make_filter(robot, barriers=()):
    """A filter with one obstacle, after one step from rest."""
    safety = SafetyFilter(load_robot(robot), barriers=barriers)
    safety.observe([BALL])
    safety.reset()
    return safety


def inputs(robot):
    """q, v and u_nom of a robot in motion; all are float32 numbers, which every sequence represents exactly."""
    state = home_state(load_robot(robot))
    q = state.q.astype(np.float32).astype(float)
    v = np.full(len(state.v), 0.125)
    return replace(state, q=q, v=v), np.full(len(v), 0.25)


def same(one, other):
    """Whether two results of the filter are equal, bit for bit."""
    return np.array_equal(one.u, other.u) and (one.status, one.flags, one.delta, one.h_min) == (
        other.status,
        other.flags,
        other.delta,
        other.h_min,
    )


@pytest.mark.parametrize("barriers", [(), (OneRow(),)], ids=["kernel", "python barrier"])
@pytest.mark.parametrize("convert", SEQUENCES.values(), ids=SEQUENCES)
@pytest.mark.parametrize("robot", ROBOTS)
def test_a_step_takes_any_sequence(robot, convert, barriers):
    state, u = inputs(robot)
    given = replace(state, q=convert(state.q), v=convert(state.v))
    by_array, by_sequence = make_filter(robot, barriers), make_filter(robot, barriers)
    assert same(by_sequence(given.q, given.v, convert(u)), by_array(state.q, state.v, u))
    assert same(by_sequence.filter(given, convert(u), 0.0), by_array.filter(state, u, 0.0))
    projected = by_sequence.project(given, convert(u), convert(state.v), 0.0)
    assert np.array_equal(projected, by_array.project(state, u, state.v, 0.0))


@pytest.mark.parametrize("convert", SEQUENCES.values(), ids=SEQUENCES)
@pytest.mark.parametrize("robot", ROBOTS)
def test_kinematics_take_any_sequence(robot, convert):
    state, _ = inputs(robot)
    safety = make_filter(robot)
    for part in ("position", "rotation", "jacobian"):
        assert np.array_equal(getattr(safety.tool(convert(state.q)), part), getattr(safety.tool(state.q), part))
    (centres, radii, groups), expected = safety.spheres(convert(state.q), 0.0), safety.spheres(state.q, 0.0)
    assert np.array_equal(centres, expected[0])
    assert np.array_equal(radii, expected[1])
    assert groups == expected[2]


def test_the_home_posture_of_the_model_is_a_configuration(panda):
    safety = SafetyFilter(panda)
    assert np.array_equal(safety.tool(panda.home).position, safety.tool(np.array(panda.home)).position)


def test_the_other_methods_take_lists(panda):
    state, u = inputs("panda")
    spheres, weight = np.array([[0.0, 0.0, 0.05, 0.02]]), np.diag(np.arange(1.0, 8.0))
    by_array, by_list = SafetyFilter(panda, weight=weight), SafetyFilter(panda, weight=weight.tolist())
    for safety, convert in ((by_array, np.asarray), (by_list, np.ndarray.tolist)):
        safety.observe([BALL])
        safety.reset(convert(state.v))
        safety.attach(convert(spheres), 0.001)
    assert same(by_list(state.q, state.v, u), by_array(state.q, state.v, u))
    stacks = [np.array([one, one]) for one in (state.q, state.v, u)]
    batches = by_list.batch(*(stack.tolist() for stack in stacks)), by_array.batch(*stacks)
    assert np.array_equal(batches[0].u, batches[1].u)


@pytest.mark.parametrize("barriers", [(), (OneRow(),)], ids=["kernel", "python barrier"])
@pytest.mark.parametrize("wrong", ["short", "long", "text", "nested", "scalar"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_another_shape_raises_a_configuration_error(robot, wrong, barriers):
    state, u = inputs(robot)
    make = {
        "short": lambda a: a[:-1],
        "long": lambda a: [*a, 0.0],
        "text": lambda a: ["x"] * len(a),
        "nested": lambda a: [list(a)],
        "scalar": lambda a: 0.0,
    }[wrong]
    safety = make_filter(robot, barriers)
    bad_q, bad_v = replace(state, q=make(state.q)), replace(state, v=make(state.v))
    calls = {
        "q of a step": [
            lambda: safety(bad_q.q, state.v, u),
            lambda: safety.filter(bad_q, u, 0.0),
            lambda: safety.project(bad_q, u, u, 0.0),
        ],
        "v of a step": [
            lambda: safety(state.q, bad_v.v, u),
            lambda: safety.filter(bad_v, u, 0.0),
            lambda: safety.project(bad_v, u, u, 0.0),
        ],
        "u_nom of a step": [lambda: safety(state.q, state.v, make(u)), lambda: safety.filter(state, make(u), 0.0)],
        "u_desired of a step": [lambda: safety.project(state, make(u), u, 0.0)],
        "u_nom_prev of a step": [lambda: safety.project(state, u, make(u), 0.0)],
        "configuration q": [lambda: safety.tool(make(state.q)), lambda: safety.spheres(make(state.q), 0.0)],
    }
    for name, attempts in calls.items():
        for attempt in attempts:
            with pytest.raises(ConfigurationError, match=f"^{name}: got"):
                attempt()


def test_wrong_spheres_and_last_controls_raise_a_configuration_error(panda):
    safety = SafetyFilter(panda)
    for spheres in ([[0.0, 0.0, 0.05]], [["x", 0.0, 0.05, 0.02]]):
        with pytest.raises(ConfigurationError, match="held spheres"):
            safety.attach(spheres, 0.0)
    for last in ([0.0] * 6, ["x"] * 7):
        with pytest.raises(ConfigurationError, match="u_prev"):
            safety.reset(last)
