"""Filtered environment: it is a valid environment, and no policy brings any h below zero, unlike in the bare one."""

import subprocess
import sys
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import FilterConfig, FilterStatus, Obstacle, SafetyFilter
from dualbrain.safety.integration.derating import derate
from dualbrain.safety.integration.gym_env import FilteredEnv
from dualbrain.safety.integration.policy_guard.action_layout import ActionLayout
from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition, JointVelocity
from dualbrain.safety.integration.policy_guard.tool_actions import ToolTwist
from dualbrain.safety.integration.policy_guard.torque_actions import JointTorque
from dualbrain.safety.integration.shadow_mode import ShadowFilter
from tests.safety.integration.gym_environments import (
    DERATED_PANDA,
    EXACT_CONFIG,
    MAX_TORQUE,
    OBSTACLES,
    PANDA,
    PERIOD,
    V_MAX,
    ReachEnv,
    TorqueEnv,
    make_filter,
    min_h,
)

SPEEDS = {
    "decode_action": lambda action: np.asarray(action, float) * V_MAX,
    "encode_action": lambda u, _: (u / V_MAX).astype(np.float32),
}
LOWER, UPPER = (np.array([getattr(joint, end).value for joint in PANDA.joints]) for end in ("lower", "upper"))
TOLERANCE = 2e-6
"""Float32 rounding of the action and its scaling, on the motion of a joint in one period [rad or m]."""


def velocity_env(length=300, safety=None, **more):
    return FilteredEnv(ReachEnv(length), safety or make_filter(), **(SPEEDS | more))


def random_policy(rng):
    """A new direction at full speed every 60 steps."""
    action = np.zeros(7)
    for step in range(10**6):
        if step % 60 == 0:
            action = rng.choice([-1.0, 1.0], 7)
        yield lambda _, action=action: action


def adversary(rng, safety):
    """Drives the tool at one of the obstacles, another one every 60 steps."""
    for step in range(10**6):
        if step % 60 == 0:
            target = np.array(OBSTACLES[1 + rng.integers(2)].pose.position) + rng.normal(0.0, 0.05, 3)

        def toward(q, target=target):
            tool = safety.tool(q)
            u = np.linalg.pinv(tool.jacobian[:3]) @ (target - tool.position)
            return np.clip(u / max(np.abs(u).max(), 1e-9) * 1.2, -1.0, 1.0)

        yield toward


def path(env, policy, steps, scale=1.0):
    """Joint angles after each step, and the infos."""
    env.reset(seed=1)
    visited, infos = [], []
    for _, choose in zip(range(steps), policy, strict=False):
        action = scale * choose(env.unwrapped.q)
        _, _, terminated, truncated, info = env.step(np.asarray(action, np.float32))
        visited.append(env.unwrapped.q)
        infos.append(info)
        if terminated or truncated:
            env.reset()
    return np.array(visited), infos


@pytest.mark.parametrize("name", ["random", "adversary"])
@pytest.mark.parametrize("seed", range(3))
def test_no_velocity_policy_brings_h_below_zero(name, seed):
    def policy():
        rng = np.random.default_rng(seed)
        return random_policy(rng) if name == "random" else adversary(rng, SafetyFilter(DERATED_PANDA))

    guarded, infos = path(velocity_env(10**6), policy(), 600)
    assert min_h(guarded) > -TOLERANCE
    assert {info["status"] for info in infos} <= {"SAFE", "MODIFIED"}
    assert max(info["cost"] for info in infos) > 0.05
    bare, _ = path(ReachEnv(10**6), policy(), 600)
    assert min_h(bare) < -0.01


def test_infos_agree_with_a_filter_that_is_called_directly():
    env, twin = velocity_env(10**6), make_filter()
    observation, _ = env.reset(seed=3)
    twin.reset()
    for step, choose in zip(range(150), random_policy(np.random.default_rng(8)), strict=False):
        action = choose(None).astype(np.float32)
        result = twin(observation[:7], observation[7:14], action.astype(float) * V_MAX, step * PERIOD)
        observation, _, _, _, info = env.step(action)
        assert (info["cost"], info["h_min"], info["status"]) == (result.delta, result.h_min, result.status.name)
        assert info["safety"] == result.explain()
        assert info["cost_rows"] == result.delta_rows
        np.testing.assert_allclose(info["applied"], result.u / V_MAX, atol=1e-7)
        np.testing.assert_allclose(env.unwrapped.v, result.u, atol=1e-6)


def test_a_repeated_action_is_filtered_in_every_step():
    fast, slow = velocity_env(10**6), velocity_env(10**6, action_repeat=4)
    (_, _), (_, _) = fast.reset(seed=2), slow.reset(seed=2)
    for choose in adversary_actions(80):
        steps = [fast.step(choose) for _ in range(4)]
        observation, reward, _, _, info = slow.step(choose)
        infos = [step[4] for step in steps]
        np.testing.assert_array_equal(observation, steps[-1][0])
        assert reward == pytest.approx(sum(step[1] for step in steps))
        assert info["cost"] == pytest.approx(np.mean([step_info["cost"] for step_info in infos]))
        assert info["h_min"] == min(step_info["h_min"] for step_info in infos)
        assert info["status"] == max((step_info["status"] for step_info in infos), key=lambda name: FilterStatus[name])
        assert info["safety"] == max(infos, key=lambda step_info: step_info["cost"])["safety"]
    assert info["status"] == "MODIFIED"


def adversary_actions(count):
    rng = np.random.default_rng(6)
    return [rng.choice([-1.0, 1.0], 7).astype(np.float32) for _ in range(count // 8) for _ in range(8)]


def test_a_repeated_action_ends_with_the_episode():
    env = velocity_env(length=10, action_repeat=4)
    env.reset(seed=0)
    ends = [env.step(np.zeros(7, np.float32))[3] for _ in range(3)]
    assert ends == [False, False, True]
    assert env.unwrapped._steps == 10


def test_a_safe_action_passes_unchanged():
    env = velocity_env()
    env.reset(seed=0)
    action = np.full(7, 0.01, np.float32)
    _, _, _, _, info = env.step(action)
    assert info["applied"] is action
    assert (info["cost"], info["status"]) == (0.0, "SAFE")


class SpeedEnv(ReachEnv):
    """The same arm with joint velocities [rad/s] as actions."""

    def __init__(self):
        super().__init__()
        self.action_space = gymnasium.spaces.Box(-V_MAX, V_MAX, dtype=np.float64)

    def step(self, action):
        return super().step(np.asarray(action, float) / V_MAX)


@pytest.mark.parametrize("whole", [[1, 0, 0, 0, 0, 0, 0], np.eye(7, dtype=int)[0]])
def test_the_safe_control_for_an_action_of_whole_numbers_keeps_its_digits(whole):
    env = FilteredEnv(SpeedEnv(), make_filter())
    env.reset(seed=0)
    info = env.step(whole)[4]
    assert info["status"] == FilterStatus.MODIFIED.name
    assert 0.0 < env.guard.control[0] < 1.0
    assert np.array_equal(info["applied"], env.guard.control)


def test_reset_clears_the_last_control():
    env = velocity_env()
    first = []
    for _ in range(2):
        env.reset(seed=5)
        first.append([env.step(np.ones(7, np.float32))[4]["applied"] for _ in range(20)])
    np.testing.assert_array_equal(*first)


@pytest.mark.filterwarnings("ignore:.*(different from the unwrapped|not having a spec):UserWarning")
def test_it_is_a_valid_environment():
    check_env(ReachEnv())
    check_env(velocity_env())
    check_env(velocity_env(safety=ShadowFilter(make_filter())))


def test_a_shadow_filter_only_observes():
    intervals = []
    observed = velocity_env(10**6, ShadowFilter(make_filter(), on_interval=intervals.append))
    policy = [adversary(np.random.default_rng(2), SafetyFilter(DERATED_PANDA)) for _ in range(2)]
    visited, infos = path(observed, policy[0], 300)
    bare, _ = path(ReachEnv(10**6), policy[1], 300)
    assert np.array_equal(visited, bare)
    assert all(info["status"] in {status.name for status in FilterStatus} for info in infos)
    assert observed.shadow.close().changed_ticks == sum(
        info["cost"] > 1e-4 or FilterStatus[info["status"]] > FilterStatus.MODIFIED for info in infos
    )
    assert intervals
    assert min(info["h_min"] for info in infos) < -0.01


def test_open_fingers_reach_farther():
    tool = SafetyFilter(PANDA).tool(np.array(PANDA.home))
    ball = Obstacle("ball", Sphere(0.02), Pose(tuple(tool.position + 0.09 * tool.rotation[:, 1])))
    h = {}
    for opening in (0.0, 0.04):
        env = velocity_env(safety=make_filter(obstacles=[ball]), opening=lambda _, opening=opening: opening)
        env.reset(seed=0)
        h[opening] = env.step(np.zeros(7, np.float32))[4]["h_min"]
        assert h[opening] == pytest.approx(min_h(np.array([PANDA.home]), [ball], opening), abs=2e-5)
    assert h[0.04] < h[0.0] - 0.005


def test_moving_obstacles_are_observed_in_every_step():
    """A ball approaches the hand from above at 10 cm/s; the policy keeps the arm at rest."""
    start = SafetyFilter(DERATED_PANDA).tool(np.array(PANDA.home)).position + np.array([0.0, 0.0, 0.35])

    def ball(now):
        place = tuple(start - np.array([0.0, 0.0, 0.1 * now]))
        return Obstacle("ball", Sphere(0.05), Pose(place), velocity=(0.0, 0.0, -0.1), static=False)

    env = velocity_env(10**6, SafetyFilter(DERATED_PANDA, EXACT_CONFIG), scene=lambda _, now: [ball(now)])
    env.reset(seed=0)
    h = []
    for step in range(700):
        _, _, _, _, info = env.step(np.zeros(7, np.float32))
        if step % 10 == 0:
            h.append(min_h(env.unwrapped.q[None], [ball((step + 1) * PERIOD)]))
    assert info["status"] == "MODIFIED"
    assert "'ball'" in info["safety"]
    assert min(h) > -TOLERANCE


def test_settings_that_break_the_guarantee_are_rejected():
    with pytest.raises(ConfigurationError, match="one step of the environment"):
        FilteredEnv(ReachEnv(), SafetyFilter(derate(PANDA, max_speed=1.5)), **SPEEDS)
    with pytest.raises(ConfigurationError, match="action space") as narrow:
        FilteredEnv(ReachEnv(), SafetyFilter(DERATED_PANDA))  # the actions are interpreted as rad/s and limited to 1
    assert "decode_action" in narrow.value.fix
    for wrong in (
        {"period": 0.0},
        {"period": 0.02},
        {"max_speed": 0.0},
        {"max_speed": 9.0},
        {"max_speed": [1.0] * 6 + [np.nan]},
        {"max_speed": []},
        {"max_speed": [1.0] * 6},
        {"max_speed": [1.0] * 8},
    ):
        with pytest.raises(ConfigurationError):
            derate(PANDA, **wrong)
    assert derate(PANDA) is PANDA


def test_a_wrapper_that_clips_actions_does_not_hide_their_bounds():
    with pytest.raises(ConfigurationError, match="must not be clipped") as narrow:
        FilteredEnv(gymnasium.wrappers.ClipAction(ReachEnv()), SafetyFilter(DERATED_PANDA))
    assert "ClipAction" in narrow.value.fix


def test_without_gymnasium_the_extra_is_named():
    code = "import sys; sys.modules['gymnasium'] = None; import dualbrain.safety.integration.gym_env"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    message = "The package gymnasium is missing. Install it with `pip install 'dualbrain[gym]'`."
    assert f"MissingDependencyError: {message}" in done.stderr


# --- torques ------------------------------------------------------------------------------------------------------

FLOOR = (OBSTACLES[0],)
PUSHED = FilterConfig(lag_compensation=False, tracking_error=0.02)


def torque_env(length=10**6, shadow=False):
    bare = TorqueEnv(length)
    safety = make_filter(PANDA, FLOOR, PUSHED)
    return FilteredEnv(bare, ShadowFilter(safety) if shadow else safety, torque=bare, opening=lambda _: 0.04)


HAND = SafetyFilter(PANDA)


def torques(env, choose, steps, seed):
    env.reset(seed=seed)
    rng, visited, infos = np.random.default_rng(seed), [], []
    joints = env.unwrapped.plant.read
    for step in range(steps):
        state = joints()
        action = choose(rng, step, state.q, state.v)
        infos.append(env.step(action)[4])
        visited.append(joints().q)
    return np.array(visited), infos


def random_torque(rng, step, q, v):
    """Bang-bang torques, with new signs every 50 ms."""
    if step % 50 == 0:
        random_torque.corner = 0.3 * rng.choice([-1.0, 1.0], 7) * MAX_TORQUE
    return random_torque.corner


def downward(rng, step, q, v):
    """Pulls the hand toward the table with 150 N."""
    return np.clip(HAND.tool(q).jacobian[2] * -150.0, -MAX_TORQUE, MAX_TORQUE)


@pytest.mark.parametrize("choose", [random_torque, downward])
def test_no_torque_policy_brings_h_below_zero(choose):
    guarded, infos = torques(torque_env(), choose, 900, 0)
    assert min_h(guarded, FLOOR, 0.04) > 0.0
    assert max(info["tracking_error"] for info in infos) < PUSHED.tracking_error
    assert {info["status"] for info in infos} <= {"SAFE", "MODIFIED"}
    bare, _ = torques(TorqueEnv(10**6), choose, 900, 0)
    assert min_h(bare, FLOOR, 0.04) < -0.005


def test_torques_report_the_tracking_error_in_both_forms():
    def errors(**form):
        env = FilteredEnv(TorqueEnv(10**6), make_filter(PANDA, FLOOR, PUSHED), opening=lambda _: 0.04, **form)
        return [info["tracking_error"] for info in torques(env, random_torque, 60, 0)[1]]

    drive = TorqueEnv(10**6)
    expected = errors(torque=drive)
    assert max(expected) > 0.0
    assert errors(action_space=JointTorque(drive=drive)) == pytest.approx(expected)


class Blocked(gymnasium.Env):
    """An arm that a person holds, so that no torque moves it. It provides its own dynamics, with unit inertia."""

    action_space = gymnasium.spaces.Box(-100.0, 100.0, (7,), np.float64)
    observation_space = gymnasium.spaces.Box(-4.0, 4.0, (14,), np.float64)

    def reset(self, *, seed=None, options=None):
        return np.concatenate([PANDA.home, np.zeros(7)]), {}

    def step(self, action):
        return self.reset()[0], 0.0, False, False, {}

    def acceleration(self, q, v, torque):
        return torque

    def track(self, q, v, u):
        return (u - v) / PANDA.period


def test_a_blocked_arm_causes_no_windup():
    """The nominal control starts from the measured velocity, not from the commanded one."""
    bare = Blocked()
    env = FilteredEnv(bare, make_filter(PANDA, (), PUSHED), torque=bare, step_time=PANDA.period)
    env.reset()
    applied = [env.step(np.full(7, 90.0))[4]["applied"] for _ in range(50)]
    np.testing.assert_allclose(applied[0], [j.acceleration.value for j in PANDA.joints], rtol=1e-5)
    np.testing.assert_allclose(applied, np.tile(applied[0], (50, 1)))


def test_a_gentle_torque_passes_unchanged():
    _, infos = torques(torque_env(), lambda *_: np.full(7, 0.05), 50, 0)
    assert {info["status"] for info in infos} == {"SAFE"}
    assert all(np.array_equal(info["applied"], np.full(7, 0.05)) for info in infos)
    assert max(info["tracking_error"] for info in infos) < 1e-3


@pytest.mark.filterwarnings("ignore:.*(different from the unwrapped|not having a spec):UserWarning")
@pytest.mark.filterwarnings("ignore:.*normalized space:UserWarning")
def test_the_torque_environment_is_valid():
    check_env(torque_env(20))
    check_env(torque_env(20, shadow=True))


class ServoEnv(ReachEnv):
    """A slow environment: an action is a joint position that the joints reach within 20 ms at constant speed."""

    dt = 4 * PERIOD

    def __init__(self):
        super().__init__(10**6)
        self.action_space = gymnasium.spaces.Box(LOWER, UPPER, dtype=np.float64)
        self.path = []

    def step(self, action):
        self.v = (np.asarray(action, float) - self.q) / self.dt
        for _ in range(4):
            self.q = self.q + PERIOD * self.v
            self.path.append(self.q)
        return self._observation(), 0.0, False, False, {}


@pytest.mark.parametrize("guarded", [False, True])
def test_a_slow_environment_with_joint_positions_is_filtered_in_every_period(guarded):
    servo, rng = ServoEnv(), np.random.default_rng(2)
    env = FilteredEnv(servo, make_filter(), action_space=JointPosition()) if guarded else servo
    observation, _ = env.reset(seed=0)
    for step in range(200):
        if step % 40 == 0:
            u = V_MAX * np.array([rng.choice([-1.0, 1.0]), 0.7, 0.0, 0.3, 0.0, 0.0, 0.0])
        observation, _, _, _, info = env.step(np.clip(observation[:7] + servo.dt * u, LOWER, UPPER))
    assert bool(min_h(np.array(servo.path)) > -TOLERANCE) is guarded
    assert not guarded or info["status"] in ("SAFE", "MODIFIED")


def test_the_time_of_a_step_is_that_of_the_environment_or_stated():
    with pytest.raises(ConfigurationError, match="Blocked does not state the time of one step") as unknown:
        FilteredEnv(Blocked(), make_filter(PANDA), torque=Blocked())
    assert "step_time=" in unknown.value.fix
    for wrong in (0.0, -0.01, float("nan"), float("inf"), "fast"):
        with pytest.raises(ConfigurationError, match="a positive number"):
            FilteredEnv(Blocked(), make_filter(PANDA), torque=Blocked(), step_time=wrong)
    with pytest.raises(ConfigurationError, match="one step of the environment"):
        FilteredEnv(ReachEnv(), make_filter(), step_time=2 * PERIOD, **SPEEDS)


@pytest.mark.parametrize("stated", [4 * PERIOD, lambda: 4 * PERIOD])
def test_a_control_timestep_is_the_time_of_a_step(stated):
    """robosuite states a number, dm_control a method, and gym-aloha wraps an environment of dm_control."""
    for owner in ("outer", "inner"):
        servo = ServoEnv()
        servo.dt = None
        holder = servo if owner == "outer" else SimpleNamespace()
        holder.control_timestep = stated
        if owner == "inner":
            servo._env = holder
        env = FilteredEnv(servo, make_filter(), action_space=JointPosition())
        assert env.guard.steps_per_action == 4


@pytest.mark.parametrize(
    "wrap",
    [
        lambda env: gymnasium.wrappers.StickyAction(env, 0.5),
        lambda env: gymnasium.wrappers.TimeLimit(gymnasium.wrappers.DelayObservation(env, 1), 10),
        lambda env: gymnasium.wrappers.MaxAndSkipObservation(env, 3),
        lambda env: gymnasium.wrappers.RepeatAction(env, 3),
    ],
)
def test_a_wrapper_that_changes_the_motion_is_refused(wrap):
    """Around the filtered environment it is harmless: each of its actions is filtered."""
    with pytest.raises(ConfigurationError, match="between the filter and the environment"):
        FilteredEnv(wrap(ServoEnv()), make_filter(), action_space=JointPosition())
    wrap(FilteredEnv(ServoEnv(), make_filter(), action_space=JointPosition()))


def test_an_action_space_replaces_the_functions_for_velocities():
    with pytest.raises(ConfigurationError, match="action_space"):
        FilteredEnv(ServoEnv(), make_filter(), action_space=JointPosition(), **SPEEDS)
    with pytest.raises(ConfigurationError, match="multiple"):
        FilteredEnv(ServoEnv(), SafetyFilter(derate(PANDA, period=0.006)), action_space=JointPosition())


DEGREES = np.pi / 180.0


@pytest.mark.parametrize(
    ("space", "low", "high", "fits"),
    [
        (JointVelocity(), -V_MAX, V_MAX, True),
        (JointVelocity(), -V_MAX.astype(np.float32), V_MAX.astype(np.float32), True),
        (JointVelocity(), -V_MAX, 0.99 * V_MAX, False),
        (JointVelocity(), -np.full(7, np.inf), np.full(7, np.inf), True),
        (JointVelocity(layout=ActionLayout(scale=-DEGREES)), -V_MAX / DEGREES, V_MAX / DEGREES, True),
        (JointVelocity(layout=ActionLayout(scale=-DEGREES)), -V_MAX, V_MAX, False),
        (JointVelocity(layout=ActionLayout(entries=(8, 1, 2, 3, 4, 5, 6))), -np.full(7, 9.0), np.full(7, 9.0), False),
        (JointPosition(), LOWER, UPPER, True),
        (JointPosition(), LOWER + 0.01, UPPER, False),
        (JointPosition(delta=True), -V_MAX * PERIOD, V_MAX * PERIOD, True),
        (JointPosition(delta=True), -0.9 * V_MAX * PERIOD, V_MAX * PERIOD, False),
        (ToolTwist(), -np.full(7, 0.01), np.full(7, 0.01), True),
    ],
)
def test_an_environment_that_would_clip_a_safe_action_is_refused(space, low, high, fits):
    env = ReachEnv()
    env.action_space = gymnasium.spaces.Box(low, high, dtype=low.dtype.type)
    if fits:
        FilteredEnv(env, make_filter(), action_space=space)
        return
    with pytest.raises(ConfigurationError, match="in the action space"):
        FilteredEnv(env, make_filter(), action_space=space)


def test_the_bounds_are_those_of_the_whole_step_and_may_be_unknown():
    env = ReachEnv()
    env.action_space = gymnasium.spaces.Box(-V_MAX * PERIOD, V_MAX * PERIOD, dtype=np.float64)
    with pytest.raises(ConfigurationError, match="changes of the joint positions"):
        FilteredEnv(env, make_filter(), action_space=JointPosition(delta=True), step_time=2 * PERIOD)
    env.action_space = gymnasium.spaces.Discrete(2)
    FilteredEnv(env, make_filter(), action_space=JointPosition(delta=True), step_time=2 * PERIOD)


@pytest.mark.parametrize("repeat", [0, -1, 1.5])
def test_an_action_must_be_repeated_at_least_once(repeat):
    with pytest.raises(ConfigurationError, match="action_repeat"):
        velocity_env(action_repeat=repeat)
