"""Jerk box: the change of the acceleration stays within its limit, and the other guarantees hold."""

import msgspec
import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import FilterStatus, SafetyFilter
from dualbrain.safety.cbf.result import Reason
from tests.safety import geometry_oracle, random_scenes


def test_a_robot_model_without_jerk_limits_is_rejected(sparse_panda):
    bare = tuple(msgspec.structs.replace(joint, jerk=None) for joint in sparse_panda.joints)
    with pytest.raises(ConfigurationError, match="jerk"):
        SafetyFilter(msgspec.structs.replace(sparse_panda, joints=bare), random_scenes.exact_config(jerk_limits=True))


@pytest.mark.parametrize("seed", range(3))
def test_jerk_stays_in_its_limit_under_an_adversary(sparse_panda, seed):
    rng = np.random.default_rng(seed)
    obstacles = random_scenes.random_scene(sparse_panda, rng, 8)
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(jerk_limits=True))
    safety.observe(obstacles)
    v_max = np.array([joint.velocity.value for joint in sparse_panda.joints])
    limit = np.array([joint.jerk.value for joint in sparse_panda.joints]) * sparse_panda.period**2
    q, log, yielded, u, before = np.array(sparse_panda.home), [], 0, np.zeros(7), np.zeros(7)
    for tick in range(4000):
        if tick % 250 == 0:
            desired = np.where(rng.random(7) < 0.5, -1.0, 1.0) * v_max
        answer = safety(q, np.zeros(7), desired, opening=0.0)
        jerk = np.abs(answer.u - 2.0 * u + before)
        if Reason.JERK in answer.reason:
            yielded += 1
        elif answer.status is not FilterStatus.RELAXED:
            assert np.all(jerk <= limit * (1 + 1e-3) + 2e-6)
        u, before = answer.u, u
        q = q + sparse_panda.period * u
        log.append(q)
    assert yielded < 40
    log = np.array(log)
    assert (
        min(
            geometry_oracle.h_obstacles(sparse_panda, log, obstacles).min(),
            geometry_oracle.h_self(sparse_panda, log).min(),
        )
        >= 0.0
    )
    assert geometry_oracle.h_joints(sparse_panda, log).min() >= 0.0


def test_without_the_box_jerk_is_larger(sparse_panda):
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config())
    limit = np.array([joint.jerk.value for joint in sparse_panda.joints]) * sparse_panda.period**2
    first = safety(np.array(sparse_panda.home), np.zeros(7), np.full(7, 2.0)).u
    assert np.any(np.abs(first) > 1.5 * limit)


def test_the_binding_limit_is_named(sparse_panda):
    """Full speed from rest, then back: jerk, acceleration and velocity limits bind in turn, each by its formula."""
    safety = SafetyFilter(sparse_panda, random_scenes.exact_config(jerk_limits=True, precision="float64"))
    first = sparse_panda.joints[0]
    dt, v_max, a_max, j_max = sparse_panda.period, first.velocity.value, first.acceleration.value, first.jerk.value
    seen, u, before = [], 0.0, 0.0
    for tick in range(2000):
        direction = 1.0 if tick < 60 else -1.0  # reversed while it still accelerates
        answer = safety(np.array(sparse_panda.home), np.zeros(7), np.array([9.0 * direction, 0, 0, 0, 0, 0, 0]))
        bounds = {
            "velocity": direction * v_max,
            "acceleration": u + direction * a_max * dt,
            "jerk": 2.0 * u - before + direction * j_max * dt**2,
        }
        for name in (name for name, _, _ in answer.active_rows if name.startswith(first.name + " ")):
            kind = name.split()[1]
            assert answer.u[0] == pytest.approx(bounds[kind], abs=1e-3 * a_max * dt), kind
            seen.append((kind, direction))
        before, u = u, float(answer.u[0])
    assert {kind for kind, _ in seen} == {"velocity", "acceleration", "jerk"}
    assert seen.count(("jerk", -1.0)) > 1, "also while the acceleration changes"
