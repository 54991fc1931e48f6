"""The approver of inspect-robots: bound or contact, unusable input, and embodiments that it refuses."""

import sys
from dataclasses import replace
from math import inf, nan

import msgspec
import numpy as np
import pytest
from inspect_robots.approver import Approver, GuardrailContribution
from inspect_robots.errors import ConfigError, SafetyAbort
from inspect_robots.registry import register
from inspect_robots.scene import Scene
from inspect_robots.spaces import ActionSemantics, Box, ObservationSpace
from inspect_robots.types import Action, StepResult
from inspect_robots_dualbrain import GuardedEmbodiment, dualbrain_guarded
from inspect_robots_dualbrain.connector import check, find_api_problems

from dualbrain import FilterConfig, HalfSpace, Obstacle, Pose, SafetyFilter, Sphere
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.importer.build_arm import unidentified_tracking
from tests.integrations.inspect_robots.arm_embodiment import HOME, LABELS, OPEN, PANDA, RATE, ArmEmbodiment

SCENE = Scene(id="a", instruction="reach")
V_MAX = np.array([joint.velocity.value for joint in PANDA.joints])
KINEMATICS = SafetyFilter(PANDA, obstacles=[Obstacle("table", HalfSpace())])
LOW = HOME + np.array([0.0, 1.5, 0.0, 0.9, 0.0, 0.0, 0.0])
"""A position with the hand below the table."""
CRATE = Obstacle("crate", Sphere(0.1), Pose((0.45, 0.25, 0.45)))


def turned(angle):
    """Home with the first joint turned by `angle` [rad]."""
    return np.append(HOME[0] + angle, HOME[1:])


def no_obstacles(model):
    return SafetyFilter(model)


def guard(inner=None, **options):
    """A guarded embodiment after its reset."""
    guarded = GuardedEmbodiment(inner or ArmEmbodiment(), PANDA, **options)
    guarded.reset(SCENE)
    return guarded


def act(guarded, values, store=None, gripper=OPEN, **meta):
    """One cycle of a rollout with the joint values (7,): review, then step; returns the executed action."""
    approved = guarded.approver.review(
        Action(data=np.append(values, gripper), meta=meta), {} if store is None else store
    )
    guarded.step(approved)
    return approved


def drive(guarded, values, steps):
    """Repeat one action; returns the reviews."""
    reviews = []
    for _ in range(steps):
        act(guarded, values)
        reviews.append(guarded.approver.last)
    return reviews


def clearance(q):
    """The smallest barrier value [m] of the arm above the table."""
    KINEMATICS.reset()
    return KINEMATICS(q, np.zeros(7), np.zeros(7), 0.0).h_min


def speeds(guarded):
    return np.abs(np.diff(guarded.inner.path, axis=0)).max(axis=1) * RATE


def is_gentle(guarded):
    """Whether the joints kept their velocity limits throughout."""
    return bool((np.abs(np.diff(guarded.inner.path, axis=0)) <= V_MAX / RATE + 1e-6).all())


# --- bound or contact ---------------------------------------------------------------------------------------------


def test_the_approver_has_the_protocol_of_inspect_robots():
    assert isinstance(guard().approver, Approver)
    assert list(find_api_problems()) == []


def test_a_safe_action_is_approved_as_the_same_object():
    guarded = guard()
    action = Action(data=np.append(HOME + 1e-4, OPEN), meta={"chunk": 3})
    assert guarded.approver.review(action, {}) is action
    assert guarded.approver.last.verdict == "approved"
    assert guarded.approver.last.limit == "none"
    assert "passed unchanged" in guarded.approver.last.explanation


def test_a_motion_that_is_too_fast_is_answered_with_a_speed_bound():
    guarded = guard(safety=no_obstacles)
    reviews = drive(guarded, turned(1.0), 8)
    assert {(review.verdict, review.limit) for review in reviews} == {("modified", "speed")}
    assert "panda_joint1 acceleration limit" in reviews[0].explanation
    assert "panda_joint1 moves at 100 % of its velocity limit, 2.17 rad/s" in reviews[-1].explanation
    assert is_gentle(guarded)


def test_a_target_outside_the_range_of_a_joint_is_answered_with_its_position_bound():
    guarded = guard(safety=no_obstacles)
    last = drive(guarded, turned(4.0), 60)[-1]
    assert (last.verdict, last.limit) == ("modified", "joint position")
    assert "panda_joint1 position limit" in last.explanation
    assert guarded.inner.q[0] <= PANDA.joints[0].upper.value


def test_a_target_below_the_table_is_answered_with_the_contact_of_link_and_object():
    guarded = guard()
    last = drive(guarded, LOW, 60)[-1]
    assert (last.verdict, last.limit) == ("modified", "contact")
    assert "vs 'table'" in last.explanation
    assert min(clearance(q) for q in guarded.inner.path) > 0.0
    assert clearance(LOW) < 0.0
    assert is_gentle(guarded)


def test_a_moving_obstacle_is_named():
    guarded = guard(scene=lambda observation, now: [CRATE] if now >= 0.0 else [])
    last = drive(guarded, turned(0.5), 60)[-1]
    assert (last.verdict, last.limit) == ("modified", "contact")
    assert "'crate'" in last.explanation


def test_a_modified_action_keeps_the_gripper_and_has_the_review():
    guarded = guard()
    action = act(guarded, LOW, gripper=0.3, note="from the policy")
    assert action.data[7] == 0.3
    assert action.meta["note"] == "from the policy"
    assert action.meta["dualbrain"] == guarded.approver.last.as_dict()
    assert not np.array_equal(action.data[:7], LOW)


def test_the_review_reaches_the_policy_and_the_log():
    guarded = guard()
    result = guarded.step(guarded.approver.review(Action(data=np.append(LOW, OPEN)), {}))
    assert result.observation.extra["dualbrain"]["verdict"] == "modified"
    assert result.info["dualbrain"]["limit"] == "speed"


def test_an_action_that_inspect_robots_clipped_is_an_action_bound_and_no_contact():
    guarded = guard()
    act(guarded, HOME + 1e-4, clamped=True)
    assert (guarded.approver.last.verdict, guarded.approver.last.limit) == ("approved", "action bound")
    assert "bounds of the action space" in guarded.approver.last.explanation
    action = act(guarded, LOW, clamped=True, delta_clamped=True)
    assert "clamped" not in action.meta
    assert "delta_clamped" not in action.meta
    assert "step limit of inspect-robots" in guarded.approver.last.explanation


def test_the_step_limit_of_inspect_robots_continues_from_the_executed_action():
    store = {"delta_limit:last": np.append(LOW, OPEN)}
    action = act(guard(), LOW, store)
    np.testing.assert_array_equal(store["delta_limit:last"], action.data)


@pytest.mark.parametrize("mode", ["joint_vel", "joint_delta"])
@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_other_control_modes_and_units_keep_clear_too(mode, unit):
    inner = ArmEmbodiment(mode, unit=unit)
    guarded = guard(inner, delta_reference="commanded")
    speed = 0.5 * (LOW - HOME) * inner.scale
    last = drive(guarded, speed if mode == "joint_vel" else speed / RATE, 60)[-1]
    assert (last.verdict, last.limit) == ("modified", "contact")
    assert min(clearance(q) for q in inner.path) > 0.0
    assert np.abs(inner.q - HOME).max() > 0.1
    assert is_gentle(guarded)


def test_labels_in_another_order_are_followed():
    class Reversed(ArmEmbodiment):
        def observation(self, **changes):
            state = {"joint_pos": self.q[::-1]}
            return super().observation(state=state, **changes)

        def step(self, action):
            return super().step(replace(action, data=np.append(action.data[1:][::-1], action.data[0])))

    guarded = guard(Reversed(labels=("gripper", *LABELS[:7][::-1])))
    before = guarded.inner.q
    guarded.step(guarded.approver.review(Action(data=np.append(OPEN, (HOME + 1e-3 * np.arange(7))[::-1])), {}))
    np.testing.assert_allclose(guarded.inner.q - before, 1e-3 * np.arange(7), atol=2e-3)
    assert guarded.inner.gripper == OPEN


def test_an_embodiment_without_stamps_is_guarded():
    guarded = guard(ArmEmbodiment(stamped=False))
    assert drive(guarded, LOW, 60)[-1].limit == "contact"
    assert min(clearance(q) for q in guarded.inner.path) > 0.0


# --- unusable actions and states ----------------------------------------------------------------------------------

BAD_ACTIONS = [np.full(8, nan), np.full(8, inf), np.zeros(7), np.zeros((8, 1)), np.zeros(0), "full speed", None]
BAD_STATES = [
    ({}, "has no state 'joint_pos'; it has none"),
    ({"eef_pos": np.zeros(3)}, "it has eef_pos"),
    ({"joint_pos": np.zeros(6)}, "has the shape (6,), expected is (8,) or (7,)"),
    ({"joint_pos": np.full(8, nan)}, "'joint_pos' is not finite"),
    ({"joint_pos": "home"}, "is no vector of numbers"),
    ({"joint_pos": np.append(HOME, OPEN), "joint_vel": np.full(8, nan)}, "'joint_vel' is not finite"),
]


def moving(inner=None, **options):
    """A guarded embodiment in a fast motion."""
    guarded = guard(inner, safety=no_obstacles, **options)
    drive(guarded, turned(2.0), 8)
    assert speeds(guarded)[-1] > 1.0
    return guarded


def expect_rest_and_abort(guarded, cycle, message):
    """Repeat the `cycle` of a rollout until the evaluation halts: the arm brakes to rest before."""
    begun = len(guarded.inner.path) - 1

    def repeat():
        for _ in range(100):
            cycle()
            assert (guarded.approver.last.verdict, guarded.approver.last.limit) == ("rejected", "input")
            assert "Remedy" in guarded.approver.last.explanation

    with pytest.raises(SafetyAbort, match=message):
        repeat()
    assert len(guarded.inner.path) - 1 > begun
    braking = speeds(guarded)[begun:]
    assert (np.diff(braking) <= 1e-6).all()
    assert braking[-1] < 1e-6


@pytest.mark.parametrize("data", BAD_ACTIONS, ids=lambda data: getattr(data, "shape", type(data).__name__))
def test_an_unusable_action_brings_the_arm_to_rest_and_then_halts(data):
    guarded = moving()
    expect_rest_and_abort(
        guarded, lambda: guarded.step(guarded.approver.review(Action(data=data), {})), "Remedy: check the output"
    )


@pytest.mark.parametrize("data", BAD_ACTIONS, ids=lambda data: getattr(data, "shape", type(data).__name__))
def test_an_unusable_first_action_halts_because_none_can_stop_the_arm(data):
    with pytest.raises(SafetyAbort, match="No action can stop the arm"):
        guard().approver.review(Action(data=data), {})


@pytest.mark.parametrize(("state", "message"), BAD_STATES, ids=[message for _, message in BAD_STATES])
def test_an_unusable_state_brings_the_arm_to_rest_and_then_halts(state, message):
    class Faulty(ArmEmbodiment):
        fault = None

        def observation(self, **changes):
            return super().observation(**({} if self.fault is None else {"state": self.fault}), **changes)

    guarded = moving(Faulty())
    guarded.inner.fault = state
    act(guarded, turned(2.0))  # its observation is the first faulty one
    escaped = message.replace("(", r"\(").replace(")", r"\)")
    expect_rest_and_abort(guarded, lambda: act(guarded, HOME), escaped)


def test_a_good_action_after_a_bad_one_moves_the_arm_again():
    guarded = moving()
    act(guarded, np.full(7, nan))
    assert guarded.approver.last.verdict == "rejected"
    act(guarded, HOME)
    assert guarded.approver.last.verdict == "modified"


@pytest.mark.parametrize(
    ("elapsed", "message"),
    [
        (0.0, "as old as that of the last one"),
        (-0.5, "not after that of the last observation"),
        (nan, "not after that of the last observation"),
        (0.2 / RATE, "control_hz promises 0.0500 s"),
    ],
)
def test_a_stale_state_and_a_wrong_clock_are_rejected(elapsed, message):
    class Frozen(ArmEmbodiment):
        stamp = None

        def observation(self, **changes):
            if self.stamp is not None:
                self.stamp = changes["state_time"] = self.stamp + elapsed
            return super().observation(**changes)

    guarded = moving(Frozen())
    guarded.inner.stamp = 1000.0 + guarded.inner.time
    act(guarded, turned(2.0))
    expect_rest_and_abort(guarded, lambda: act(guarded, HOME), message)


def test_two_actions_for_one_observation_are_rejected():
    guarded = moving()
    guarded.approver.review(Action(data=np.append(HOME, OPEN)), {})
    guarded.approver.review(Action(data=np.append(HOME, OPEN)), {})
    assert "no observation since the last action" in guarded.approver.last.explanation


def test_a_review_before_the_reset_halts():
    guarded = GuardedEmbodiment(ArmEmbodiment(), PANDA)
    with pytest.raises(SafetyAbort, match="There is no observation yet"):
        guarded.approver.review(Action(data=np.append(HOME, OPEN)), {})


def test_an_old_state_of_a_real_arm_is_held_once_and_the_next_action_moves():
    times = [0.0]
    guarded = guard(ArmEmbodiment(simulated=False), max_state_age=1.0, clock=lambda: times[0])
    act(guarded, HOME + 0.01)
    times[0] += 5.0  # the policy answers late
    held = act(guarded, HOME + 0.3)
    assert "5.00 s old, allowed are 1 s" in guarded.approver.last.explanation
    assert np.abs(held.data[:7] - HOME).max() < 0.02
    act(guarded, HOME + 0.3)
    assert guarded.approver.last.verdict == "modified"


def test_the_state_of_a_simulator_does_not_age():
    times = [0.0]
    guarded = guard(clock=lambda: times[0])
    times[0] = 100.0
    act(guarded, HOME + 1e-4)
    assert guarded.approver.last.verdict == "approved"


# --- the embodiment around it -------------------------------------------------------------------------------------


def test_an_action_that_was_not_reviewed_is_never_executed():
    guarded = guard()
    with pytest.raises(SafetyAbort, match=r"approver=embodiment\.approver"):
        guarded.step(Action(data=np.append(HOME, OPEN)))
    approved = guarded.approver.review(Action(data=np.append(HOME, OPEN)), {})
    with pytest.raises(SafetyAbort):
        guarded.step(replace(approved))
    with pytest.raises(SafetyAbort):
        guarded.step(approved)  # it was withdrawn
    assert len(guarded.inner.path) == 1
    approved = guarded.approver.review(Action(data=np.append(HOME, OPEN)), {})
    guarded.step(approved)
    with pytest.raises(SafetyAbort):
        guarded.step(approved)
    assert len(guarded.inner.path) == 2


def test_the_approver_is_contributed_after_those_of_the_inner_embodiment():
    class Contributing(ArmEmbodiment):
        def contribute_guardrails(self, action_space):
            assert action_space is self.info.action_space
            return GuardrailContribution(approvers=(("own", guard().approver),), warnings=("a warning",))

    for inner, names in ((ArmEmbodiment(), ["dualbrain"]), (Contributing(), ["own", "dualbrain"])):
        guarded = guard(inner)
        contribution = guarded.contribute_guardrails(guarded.info.action_space)
        assert [name for name, _ in contribution.approvers] == names
        assert contribution.approvers[-1][1] is guarded.approver
        assert contribution.warnings == (("a warning",) if len(names) > 1 else ())


def test_optional_hooks_are_those_of_the_inner_embodiment():
    guarded = guard()
    guarded.bind_task("envelope")
    assert guarded.inner.envelope == "envelope"
    assert getattr(guarded, "connect_operator_session", None) is None
    guarded.close()
    assert guarded.inner.closed
    assert guarded.info.name == "arm+dualbrain"


def test_a_result_keeps_its_other_fields():
    class Ending(ArmEmbodiment):
        def step(self, action):
            observation = super().step(action).observation
            return StepResult(observation=observation, reward=2.0, terminated=True, info={"own": 1})

    guarded = guard(Ending())
    result = guarded.step(guarded.approver.review(Action(data=np.append(HOME, OPEN)), {}))
    assert (result.reward, result.terminated, result.info["own"]) == (2.0, True, 1)


def changed(inner, **fields):
    """`inner` with other fields of its action space."""
    box = replace(inner.info.action_space, **fields)
    inner.info = replace(inner.info, action_space=box)
    return inner


@pytest.mark.parametrize(
    ("inner", "options", "message"),
    [
        (ArmEmbodiment("eef_delta_pos"), {}, "got 'eef_delta_pos', allowed: joint_pos, joint_vel, joint_delta"),
        (changed(ArmEmbodiment(), semantics=None), {"joints": "0123456"}, "control mode of arm: got None"),
        (changed(ArmEmbodiment(), shape=(2, 4), low=None, high=None), {}, "shape of the action space"),
        (ArmEmbodiment(labels=tuple("abcdefgh")), {}, "'panda_joint1' is not a joint of the embodiment arm"),
        (ArmEmbodiment(), {"joints": ("panda_joint1", "elbow")}, "7 different names"),
        (ArmEmbodiment(), {"joints": ("gripper",) * 7}, "7 different names"),
        (ArmEmbodiment("joint_delta"), {}, "commanded or measured"),
        (ArmEmbodiment(unit="normalized"), {}, "unit of 'joint_pos' of arm: got 'normalized'"),
        (ArmEmbodiment(), {"units": "deg"}, "got 'rad, stated: deg'"),
        (ArmEmbodiment(rate=None), {}, "control_hz of arm"),
        (ArmEmbodiment(rate=nan), {}, "control_hz of arm"),
        (ArmEmbodiment(), {"max_state_age": 0.0}, "max_state_age"),
    ],
)
def test_an_embodiment_that_does_not_fit_is_refused_with_a_remedy(inner, options, message):
    with pytest.raises((ConfigurationError, UnknownNameError), match=message):
        GuardedEmbodiment(inner, PANDA, **options)


@pytest.mark.parametrize("rate", [10.0, 20.0, 50.0, 200.0, 1000.0])
def test_the_filter_runs_at_a_period_for_which_the_kernel_has_room(rate):
    review = GuardedEmbodiment(ArmEmbodiment(rate=rate), PANDA).approver.guard
    period = review.safety.robot_model.period
    assert period <= 0.004
    assert review.steps_per_action * period == pytest.approx(1.0 / rate)


def test_a_robot_whose_tracking_error_is_not_identified_needs_a_stated_margin():
    model = msgspec.structs.replace(PANDA, tracking=unidentified_tracking())
    with pytest.raises(ConfigurationError, match="not identified"):
        GuardedEmbodiment(ArmEmbodiment(), model)
    exact = FilterConfig(tracking_error=0.0)
    GuardedEmbodiment(ArmEmbodiment(), model, safety=lambda derated: SafetyFilter(derated, exact))


def test_joints_without_labels_are_indices_and_undeclared_units_radians():
    inner = changed(ArmEmbodiment(), semantics=ActionSemantics(control_mode="joint_pos"))
    inner.info = replace(inner.info, observation_space=ObservationSpace(state_keys=frozenset({"joint_pos"})))
    guarded = guard(inner, joints=tuple("0123456"))
    assert drive(guarded, LOW, 60)[-1].limit == "contact"


def test_the_registered_embodiment_reads_its_options_and_refuses_as_inspect_robots_does():
    register("embodiment", "test_arm")(ArmEmbodiment)
    guarded = dualbrain_guarded(
        inner="test_arm", guard_model="panda", stamped=False, guard_joints=", ".join(LABELS[:7])
    )
    assert guarded.inner.stamped is False
    guarded.reset(SCENE)
    assert drive(guarded, LOW, 60)[-1].limit == "contact"
    with pytest.raises(ConfigError, match="Closest: 'panda_joint7'"):
        dualbrain_guarded(inner="test_arm", guard_model="panda", guard_joints="panda_joint77,1,2,3,4,5,6")
    with pytest.raises(ConfigError, match="'pandaa' is not a robot"):
        dualbrain_guarded(inner="test_arm", guard_model="pandaa")


def test_the_check_of_the_connector_names_what_inspect_robots_lacks(monkeypatch):
    types = sys.modules["inspect_robots.types"]
    connector = sys.modules["inspect_robots_dualbrain.connector"]
    monkeypatch.setattr(connector, "RECORD_FIELDS", {types.Action: ("data", "pose"), Box: ("shape",)})
    monkeypatch.setattr(connector, "EMBODIMENT", "no_such_embodiment")
    assert check() == [
        "Action of inspect-robots has no pose. Use inspect-robots 0.60.0.",
        "inspect-robots does not find the embodiment no_such_embodiment. Install the connector again.",
    ]
