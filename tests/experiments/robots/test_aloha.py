"""The parts of experiment `aloha_arms` that need no gym-aloha, or only its data: judge, servos, policies, tables."""

import mujoco
import numpy as np
import pytest

from dualbrain.errors import MissingDependencyError
from experiments.engine.experiment import Options
from experiments.robots.aloha.aloha_arms import HANDS_FREE, N_SEEDS, AlohaArms, unwanted
from experiments.robots.aloha.episode import MAX_STEPS, MODES, TASKS
from experiments.robots.aloha.inverse_kinematics import START
from experiments.robots.aloha.judge import KINDS, ContactJudge, kind_of
from experiments.robots.aloha.policies import CAREFUL_SPEED, STEP_TIME, RandomPolicy, transfer_policy
from experiments.robots.aloha.servo_arm import ServoArm, mjcf_file

HAND, OTHER_HAND, ARM, OTHER_ARM = ("left", "hand"), ("right", "hand"), ("left", "arm"), ("right", "arm")
TABLE, CUBE = ("", "table"), ("", "object")


@pytest.fixture
def model():
    try:
        return mujoco.MjModel.from_xml_path(str(mjcf_file()))
    except MissingDependencyError as missing:
        pytest.skip(str(missing))


@pytest.mark.parametrize(
    ("one", "other", "kind"),
    [
        (ARM, OTHER_ARM, "arm and arm"),
        (HAND, OTHER_ARM, "arm and arm"),
        (HAND, OTHER_HAND, "hand and hand"),
        (ARM, TABLE, "arm and table"),
        (HAND, TABLE, "hand and table"),
        (OTHER_ARM, CUBE, "arm and object"),
        (HAND, CUBE, ""),
        (HAND, HAND, ""),
        (HAND, ARM, "within one arm"),
        (TABLE, CUBE, ""),
    ],
)
def test_a_contact_has_one_kind_in_both_orders(one, other, kind):
    assert kind_of(one, other) == kind_of(other, one) == kind
    assert not kind or kind in KINDS


def test_the_judge_sees_a_hand_in_the_table_and_none_above_it(model):
    data = mujoco.MjData(model)
    data.qpos[:6] = data.qpos[8:14] = START
    data.qpos[18] = 0.05
    for lowered in (False, True):
        judge = ContactJudge(model, data)
        data.qpos[:6] = [0.0, 0.35, 0.4, 0.0, 0.9, 0.0] if lowered else START
        mujoco.mj_forward(model, data)
        judge.update()
        assert ("hand and table" in judge.times) == lowered
        assert judge.times.keys() == judge.peaks.keys()


def test_the_servos_sag_under_a_load_and_follow(model):
    del model
    empty, loaded = (ServoArm(load=kg, start=START) for kg in (0.0, 0.5))
    for arm in (empty, loaded):
        for _ in range(50):
            arm.apply(np.zeros(6))
        arm.measure()
    sag = [np.abs(arm.q - START).max() for arm in (empty, loaded)]
    assert 0.001 < sag[0] < 0.02 < sag[1]
    for _ in range(50):
        empty.apply(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    empty.measure()
    assert empty.q[0] == pytest.approx(0.3, abs=0.08)


@pytest.mark.parametrize("cube", [(0.0, 0.4, 0.05), (0.2, 0.6, 0.05), (0.1, 0.5, 0.05)])
def test_the_careful_policy_is_slow_and_ends_with_the_cube_in_the_left_hand(model, cube):
    policy = transfer_policy(model, np.array(cube), careful=True)
    q, last, grippers = {"left": START, "right": START}, None, []
    for _ in range(MAX_STEPS["careful"]):
        action = policy.action(q)
        q = {"left": action[:6], "right": action[7:13]}
        if last is not None:
            assert np.abs(np.delete(action - last, [6, 13])).max() <= CAREFUL_SPEED * STEP_TIME + 1e-9
        last = action
        grippers.append((action[6], action[13]))
    assert grippers[0] == (1.0, 1.0)
    assert grippers[-1] == (0.0, 1.0)
    assert (0.0, 0.0) in grippers, "both hands hold it in between"


def test_a_random_policy_holds_its_targets_and_depends_on_its_seed():
    first, again, other = (RandomPolicy(seed) for seed in (0, 0, 1))
    actions = [first.action({}) for _ in range(60)]
    assert len({tuple(action) for action in actions}) == 3
    assert all(np.array_equal(action, again.action({})) for action in actions)
    assert not np.array_equal(actions[0], other.action({}))


def test_every_unit_is_an_episode_that_exists_and_a_prefix_has_every_condition(tmp_path):
    units = AlohaArms().units(Options(tmp_path, ""))
    assert len({unit.key for unit in units}) == len(units)
    for unit in units:
        assert unit.parameters["task"] in TASKS
        assert unit.parameters["mode"] in MODES
        assert unit.parameters["policy"] in MAX_STEPS
    conditions = [tuple(unit.parameters[name] for name in ("task", "policy", "mode")) for unit in units]
    assert set(conditions[: len(units) * 5 // N_SEEDS]) == set(conditions)


def test_contacts_that_are_left_to_the_hands_are_not_unwanted():
    times = {"hand and hand": 0.1, "arm and table": 0.2}
    assert unwanted({"mode": "guarded", "times": times}) == ["hand and hand", "arm and table"]
    assert unwanted({"mode": HANDS_FREE, "times": times}) == ["arm and table"]
