"""Two sizes of the kernel: equal results bit for bit, selected by the size of the robot model, never mixed."""

import msgspec
import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf import kernel
from dualbrain.safety.cbf.compiled import _kernel, _kernel64, _kernel64_wide, _kernel_wide
from dualbrain.safety.cbf.filter import FilterConfig, SafetyFilter
from tests.safety.random_scenes import random_scene

STEPS = 4000


@pytest.fixture
def wide_only(monkeypatch):
    """Filters with the large build for any robot model."""

    def make(body, config=None):
        with monkeypatch.context() as patch:
            patch.setattr(kernel, "BUILD_SUFFIXES", ("_wide",))
            return SafetyFilter(body, config)

    return make


@pytest.mark.parametrize(
    ("name", "real", "speed"),
    [("panda", "float32", None), ("ur5e", "float32", None), ("panda", "float64", None), ("panda", "float32", 0.3)],
)
def test_both_sizes_return_equal_results_bit_for_bit(name, real, speed, wide_only, rng):
    robot_model, config = load_robot(name), FilterConfig(precision=real, cartesian_speed=speed)
    obstacles, v_max = (
        random_scene(robot_model, rng, 12),
        np.array([joint.velocity.value for joint in robot_model.joints]),
    )
    narrow, wide = SafetyFilter(robot_model, config), wide_only(robot_model, config)
    assert type(narrow._kernel) is not type(wide._kernel)
    for safety in (narrow, wide):
        safety.observe(obstacles)
    q, u, desired, bound = np.array(robot_model.home), np.zeros(robot_model.n), np.zeros(robot_model.n), 0
    for step in range(STEPS):
        if step % 60 == 0:
            desired = rng.choice([-1.0, 1.0], robot_model.n) * v_max
        one, other = narrow(q, u, desired), wide(q, u, desired)
        assert one.u.tobytes() == other.u.tobytes()
        assert (one.status, one.flags, one.delta, one.h_min, one.binding_rows) == (
            other.status,
            other.flags,
            other.delta,
            other.h_min,
            other.binding_rows,
        )
        bound += len(one.binding_rows) > 1
        u, q = one.u, q + robot_model.period * one.u
    assert bound > STEPS / 10


def test_the_smallest_build_with_room_is_taken(panda):
    many_spheres = msgspec.structs.replace(panda, spheres=panda.spheres + panda.spheres[-9:])
    assert kernel.select_build(panda, FilterConfig()) is _kernel
    assert kernel.select_build(panda, FilterConfig(precision="float64")) is _kernel64
    assert kernel.select_build(many_spheres, FilterConfig()) is _kernel_wide
    assert kernel.select_build(many_spheres, FilterConfig(precision="float64")) is _kernel64_wide
    assert _kernel.source_hash == _kernel_wide.source_hash


def test_a_robot_model_too_large_for_all_builds_is_rejected_with_the_number(panda):
    many_spheres = msgspec.structs.replace(panda, spheres=panda.spheres * 3)
    with pytest.raises(ConfigurationError, match=r"spheres of the robot model: got 312, allowed: at most 232"):
        SafetyFilter(many_spheres)


def test_handles_of_one_build_are_rejected_by_another(panda, wide_only):
    """Closed loops in C read structures of a kernel, whose sizes depend on the build."""
    zeros = {name: np.zeros(0) for name in ("rotation", "offset", "lower", "upper", "v_max", "a_max", "frame", "first")}
    judge = _kernel.ReferenceDistance(
        {"n": panda.n, **zeros, "pairs": np.zeros(0), "centres": np.zeros(0), "radii": np.zeros(0)}
    )
    parts = wide_only(panda)._kernel.handles()
    with pytest.raises(ValueError, match="handles of a kernel of this build"):
        judge.run_worst_case_loop(parts, np.empty((0, 24)), {}, np.zeros(panda.n), np.empty((0, panda.n)))
