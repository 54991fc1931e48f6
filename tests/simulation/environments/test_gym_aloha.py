"""Two guarded arms, as in gym-aloha: they never touch each other or the table under hostile policies."""

import dataclasses

import gymnasium
import numpy as np
import pytest

from dualbrain.errors import ConfigurationError, DualbrainError
from dualbrain.robots.model import TrackingErrorModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.simulation.environments import guard_aloha
from dualbrain.simulation.environments.guarded_arms import ArmPlace, GuardedArms
from tests.simulation.environments.two_arm_env import (
    ENTRIES,
    GRIPPERS,
    HOME,
    SIDES,
    STEP_TIME,
    VX300S,
    TwoArmEnv,
    home_action,
)

EXACT = FilterConfig(lag_compensation=False, tracking_error=0.0)
"""The joints of the test environment follow exactly."""
REACHING = np.array([0.0, 0.35, 0.2, 0.0, -0.3, 0.0])
"""A posture in which the hand of each arm is beyond the middle."""
OTHER = {"left": "right", "right": "left"}


@pytest.fixture
def guarded():
    env = guard_aloha(TwoArmEnv(), config=EXACT)
    env.reset(seed=0)
    return env


def action_of(left, right, grippers=(0.3, 0.7)):
    return np.concatenate([left, grippers[:1], right, grippers[1:]])


def hostile_run(env, seed, steps=300):
    """Least distances of the arms from each other and from the table, while both are sent to random postures."""
    rng, apart, above = np.random.default_rng(seed), np.inf, np.inf
    env.reset(seed=seed)
    for step in range(steps):
        if step % 60 == 0:
            spread = np.array([0.5, 0.6, 0.6, 1.0, 1.0, 1.0])
            goal = action_of(*(REACHING + rng.uniform(-spread, spread) for _ in range(2)))
        _, _, _, _, info = env.step(goal if hasattr(env, "guards") else slowly(env, goal))
        apart = min(apart, env.unwrapped.arm_distance())
        above = min(above, env.unwrapped.table_distance())
    return apart, above, info


def slowly(env, goal):
    """The action at the speed limit of the guard, for a comparison without it."""
    present = action_of(env.posture("left"), env.posture("right"))
    return present + np.clip(goal - present, -0.5 * STEP_TIME, 0.5 * STEP_TIME)


def test_two_arms_that_are_driven_at_each_other_never_touch():
    unguarded = [hostile_run(TwoArmEnv(), seed)[:2] for seed in range(4)]
    assert min(apart for apart, _ in unguarded) < 0.0
    assert min(above for _, above in unguarded) < 0.0
    env = guard_aloha(TwoArmEnv(), config=EXACT)
    for seed in range(4):
        apart, above, _ = hostile_run(env, seed)
        assert apart > 0.0, seed
        assert above > 0.0, seed


@pytest.mark.parametrize("mover", SIDES)
def test_an_arm_at_rest_stays_and_is_not_touched_by_the_other(guarded, mover):
    """The policy of one arm reaches beyond the middle and stays there; the other one is driven into it."""
    rest = {OTHER[mover]: REACHING, mover: HOME}
    for _ in range(150):
        guarded.step(action_of(rest["left"], rest["right"]))
    for _ in range(250):
        goal = rest | {mover: REACHING}
        *_, info = guarded.step(action_of(goal["left"], goal["right"]))
        assert guarded.unwrapped.arm_distance() > 0.0
        np.testing.assert_array_equal(info["applied"][ENTRIES[OTHER[mover]]], REACHING)
        assert info["arms"][OTHER[mover]]["status"] == "SAFE"
    assert np.abs(guarded.unwrapped.posture(mover) - REACHING).max() > 0.1, "the mover was stopped"
    assert guarded.unwrapped.arm_distance() < 0.03, "it came near"


def test_each_arm_takes_at_most_half_of_the_distance_per_step(guarded):
    """Both arms approach at full speed: h falls by at most α h per second in all, from any distance."""
    alpha, last = VX300S.alpha, None
    for _ in range(250):
        guarded.step(action_of(REACHING, REACHING))
        h = guarded.unwrapped.arm_distance()
        if last is not None:
            assert h >= (1.0 - alpha * STEP_TIME) * last - 1e-3
        last = h
    assert 0.0 < last < 0.02


def test_both_filters_have_the_same_distance_of_the_arms(guarded):
    """The least h of a filter is that of the simulation, and equal for both arms, within the sampling margin."""
    for _ in range(160):
        *_, info = guarded.step(action_of(REACHING, REACHING))
    before = guarded.unwrapped.arm_distance()
    *_, info = guarded.step(action_of(REACHING, REACHING))
    for side in SIDES:
        assert info["arms"][side]["h_min"] == pytest.approx(before, abs=1e-3)


def test_the_other_arm_is_where_its_filter_predicts_it():
    """Its spheres are at y = q + lag v."""
    tracking = TrackingErrorModel(lag=0.1, position_error=0.0, rate=VX300S.alpha, provenance="test", drive="position")
    exact = FilterConfig(tracking_error=0.0)
    env = guard_aloha(TwoArmEnv(), robot_model=VX300S.with_tracking(tracking), config=exact)
    env.reset(seed=0)
    inner = env.unwrapped
    moved = HOME + np.array([0.004, 0.0, -0.003, 0.0, 0.002, 0.0])
    inner.execute(action_of(HOME, moved))
    velocity = (moved - HOME) / STEP_TIME
    env.step(action_of(HOME, moved))
    found = [one for one in env.guards["left"].safety.tables.obstacles if one.name == "right/fingers"]
    inner.execute(action_of(HOME, moved + 0.1 * velocity))
    expected = [inner.data.geom_xpos[g] for g in inner.geoms["right"] if "fingers" in inner.model.geom(g).name]
    base = inner.data.body("vx300s_left").xpos
    np.testing.assert_allclose([one.pose.position for one in found], np.array(expected) - base, atol=1e-6)
    assert all(one.alpha == VX300S.alpha / 2 for one in found)


def test_the_entries_of_the_grippers_pass_unchanged(guarded):
    for grippers in ((0.0, 1.0), (0.25, -3.0)):
        *_, info = guarded.step(action_of(HOME + 1.0, HOME - 1.0, grippers))
        assert not np.array_equal(info["applied"][ENTRIES["left"]], HOME + 1.0)
        np.testing.assert_array_equal(info["applied"][GRIPPERS], grippers)


def bad_actions():
    for entry in (2, 6, 9, 13):
        action = home_action()
        action[entry] = np.nan
        yield pytest.param(action, id=f"NaN at {entry}")
    yield pytest.param(np.full(14, np.inf), id="infinite")
    yield pytest.param(np.zeros(13), id="too short")
    yield pytest.param(np.zeros((2, 7)), id="another shape")
    yield pytest.param(None, id="none")


@pytest.mark.parametrize("bad", list(bad_actions()))
def test_an_unusable_action_brings_both_arms_to_rest(guarded, bad):
    for _ in range(40):
        guarded.step(action_of(HOME + 0.4, HOME - 0.4, (0.2, 0.9)))
    speeds = [np.abs(guarded.unwrapped.data.qvel).max()]
    for _ in range(20):
        before = {side: guarded.unwrapped.posture(side) for side in SIDES}
        *_, info = guarded.step(bad)
        speeds.append(max(np.abs(guarded.unwrapped.posture(side) - before[side]).max() for side in SIDES) / STEP_TIME)
        np.testing.assert_array_equal(info["applied"][GRIPPERS], (0.2, 0.9))
        for side in SIDES:
            assert "comes to rest" in info["arms"][side]["safety"]
    assert speeds[0] > 0.3
    assert speeds[-1] == 0.0
    assert np.all(np.diff(speeds) <= 1e-9), "the arms only brake"


def test_a_state_that_is_not_finite_is_refused(guarded):
    guarded.unwrapped.data.qpos[guarded.unwrapped.model.joint("vx300s_left/elbow").qposadr[0]] = np.nan
    with pytest.raises(ConfigurationError, match="left"):
        guarded.step(home_action())


def test_the_first_action_of_all_must_be_usable(guarded):
    with pytest.raises(ConfigurationError, match="No action can stop the arm"):
        guarded.step(np.full(14, np.nan))


def test_what_hands_may_touch_they_reach_and_the_arms_do_not():
    low = np.array([0.0, 0.6, 0.1, 0.0, 0.9, 0.0])
    strict, permissive = (guard_aloha(TwoArmEnv(), config=EXACT, may_touch=may) for may in ((), ("table", "hand")))
    for goal in (REACHING, low):
        for env in (strict, permissive):
            env.reset(seed=0)
            for _ in range(250):
                env.step(action_of(goal, goal))
                assert env.unwrapped.arm_distance(hands=False) > 0.0
                assert env.unwrapped.table_distance(hands=False) > 0.0
    assert permissive.unwrapped.table_distance() < 0.0 < strict.unwrapped.table_distance()


@pytest.mark.parametrize("words", [("cube",), "table", ("table", "arm")])
def test_an_unknown_word_of_what_may_be_touched_is_refused(words):
    with pytest.raises(ConfigurationError, match="may_touch"):
        guard_aloha(TwoArmEnv(), may_touch=words)


def test_an_environment_without_the_arms_is_refused():
    with pytest.raises(DualbrainError, match="CartPoleEnv"):
        guard_aloha(gymnasium.make("CartPole-v1"))


def test_a_wrapper_that_clips_joint_positions_is_refused():
    """gym-aloha states ±1 and passes positions on; with `ClipAction` the elbow would jump from 1.16 to 1 rad."""
    with pytest.raises(ConfigurationError, match="must not be clipped") as found:
        guard_aloha(gymnasium.wrappers.TimeLimit(gymnasium.wrappers.ClipAction(TwoArmEnv()), 9), config=EXACT)
    assert "ClipAction" in found.value.fix


def place_of(side, **changes):
    """The place of one arm of `TwoArmEnv`."""
    place = ArmPlace(
        name=side,
        joints=tuple(f"vx300s_{side}/{joint.name}" for joint in VX300S.joints),
        base=f"vx300s_{side}",
        entries=tuple(range(13))[ENTRIES[side]],
    )
    return dataclasses.replace(place, **changes)


def wide_env():
    """The environment with an action space that contains the joint limits."""
    env = TwoArmEnv()
    env.action_space = gymnasium.spaces.Box(-3.2, 3.2, (14,), np.float64)
    return env


def test_other_arms_whose_action_space_is_too_narrow_are_refused():
    places = [place_of(side) for side in SIDES]
    with pytest.raises(ConfigurationError, match="must not be clipped"):
        GuardedArms(TwoArmEnv(), VX300S, places, config=EXACT)
    GuardedArms(wide_env(), VX300S, places, config=EXACT)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"name": "left"}, "left more than once"),
        ({"joints": place_of("left").joints}, "vx300s_left/.* more than once"),
        ({"entries": place_of("left").entries}, "entries .* more than once"),
        ({"entries": tuple(range(5, 11))}, "5 more than once"),
    ],
    ids=["name", "joints", "entries", "one entry"],
)
def test_places_that_share_a_name_a_joint_or_an_entry_are_refused(changes, words):
    places = [place_of("left"), place_of("right", **changes)]
    with pytest.raises(ConfigurationError, match=words):
        GuardedArms(wide_env(), VX300S, places, config=EXACT)


def test_no_place_at_all_is_refused():
    with pytest.raises(ConfigurationError, match="places"):
        GuardedArms(wide_env(), VX300S, [], config=EXACT)


@pytest.mark.parametrize(("servo_range", "fits"), [((-1.0, 1.0), False), ((-1.76278, 1.6057), True)])
def test_servos_that_mujoco_clips_to_less_than_the_joint_limits_are_refused(servo_range, fits):
    env = TwoArmEnv(servo_range=servo_range)
    if fits:
        guard_aloha(env, config=EXACT)
        return
    with pytest.raises(ConfigurationError, match="vx300s_left/elbow"):
        guard_aloha(env, config=EXACT)


@pytest.mark.slow
def test_the_guard_fits_the_real_package():
    """`gym_aloha` with random targets: no arm touches the other one or the table in any step of 20 ms."""
    pytest.importorskip("dm_control")
    pytest.importorskip("gym_aloha")
    real = gymnasium.make("gym_aloha/AlohaTransferCube-v0")
    real.unwrapped._env.physics.render = lambda height, width, **_: np.zeros((height, width, 3), np.uint8)
    env, rng = guard_aloha(real), np.random.default_rng(0)
    env.reset(seed=0)
    model, data = real.unwrapped._env.physics.model.ptr, real.unwrapped._env.physics.data.ptr
    for step in range(200):
        if step % 25 == 0:
            goal = action_of(*(REACHING + rng.uniform(-0.6, 0.6, 6) for _ in range(2)))
        env.step(goal)
        pairs = [{model.body(model.geom_bodyid[g]).name.partition("/")[0] for g in c.geom} for c in data.contact]
        assert {"vx300s_left", "vx300s_right"} not in pairs
        assert all("table" not in pair or "box" in pair for pair in pairs)
