"""The control loop in C decides as `SafetyController`, bit for bit; late and bad inputs stop the arm in time."""

import time
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.errors import ConfigurationError
from dualbrain.robots.interface import RobotState, home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import Obstacle, SafetyFilter
from dualbrain.safety.control_thread import ControlThread, ControlThreadConfig
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.controller import SafetyController
from dualbrain.safety.supervisor.timing import FRANKA, SIMULATED

PERIOD = 0.001003
"""No multiple of it is a threshold of a check, where integer and float times round differently [s]."""
HOME = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8])


@pytest.fixture(scope="module")
def arm(sparse_panda):
    """Without the supervision of contact forces, which the loop in C does not have."""
    return msgspec.structs.replace(sparse_panda, force_sensing=None)


def obstacle(x, **changes):
    return Obstacle("ball", Sphere(0.08), Pose((x, 0.1, 0.5)), **changes)


class Bench:
    """A control loop on a virtual clock with an arm in Python, whose measurements a test can spoil."""

    def __init__(self, robot_model, timing=SIMULATED, **config):
        self.model = robot_model
        self.safety = SafetyFilter(robot_model)
        self.scenes = {}
        self.loop = ControlThread(self.safety, ControlThreadConfig(**config), timing=timing)
        self.now, self.sequence, self.standstill = 1.0, 0, False
        self.q, self.v, self.u, self.drive = HOME.copy(), np.zeros(7), np.zeros(7), True
        self.show([])

    def show(self, obstacles):
        self.safety.observe(obstacles, self.now)
        self.scenes[self.loop.submit_scene()] = (list(obstacles), self.now)

    def measured(self, **changes):
        self.sequence += 1
        values = {
            "stamp": round(self.now * 1e6) / 1e6,
            "sequence": self.sequence,
            "q": self.q.copy(),
            "v": self.v.copy(),
        }
        return RobotState(
            **values | {"opening": None, "finger_forces": (0.0, 0.0), "drive_enabled": self.drive} | changes
        )

    def step(self, u_nom=None, *, silent=False, **changes):
        self.now += PERIOD
        lag = self.model.tracking.lag
        target = self.u if self.drive else np.zeros(7)
        before, self.v = self.v, self.v + (target - self.v) * min(1.0, PERIOD / max(lag, 0.002))
        self.q = self.q + 0.5 * (before + self.v) * PERIOD
        if not silent:
            self.loop.push_state(self.measured(**changes))
        if u_nom is not None:
            self.loop.submit_control(u_nom, standstill=self.standstill)
        self.loop.tick(self.now)
        for _, u, drive in self.loop.pop_commands():
            self.u, self.drive = np.array(u), drive

    def run(self, seconds, u_nom=None, **changes):
        for _ in range(round(seconds / PERIOD)):
            self.step(u_nom, **changes)
        return self.loop.read_log()


def replay(records, robot_model, scenes):
    """Every record again through `SafetyController`; asserts equal decisions and equal bits."""
    safety = SafetyFilter(robot_model)
    controller, current, scene = SafetyController(safety), None, 0
    n = robot_model.n
    for one in records:
        now = int(one["now_us"]) / 1e6
        if one["scene_number"] != scene:
            scene = int(one["scene_number"])
            safety.observe(*scenes[scene])
        if one["new_state"]:
            state = RobotState(
                stamp=int(one["state_stamp_us"]) / 1e6,
                sequence=int(one["state_sequence"]),
                q=one["state_q"][:n].copy(),
                v=one["state_v"][:n].copy(),
                opening=None,
                finger_forces=(0.0, 0.0),
                drive_enabled=bool(one["state_drive_enabled"]),
                desired_v=one["state_desired_v"][:n].copy() if one["state_has_desired"] else None,
                desired_a=one["state_desired_a"][:n].copy() if one["state_has_desired"] else None,
            )
            usable = controller.accept_state(state, now)
            assert usable == one["state_used"]
            if usable and current is None:
                controller.expect_drive_on(state, now)
            current = state if usable else current
        else:
            controller.report(controller.monitor.check_age(now))
        controller.speed_scale = float(one["speed_scale"])
        decision = controller.decide(current, now, int(one["external"]))
        assert (controller.continue_desired_motion(current) is not None) == one["continued"], one["tick"]
        result = controller.control(current, one["u_nom"][:n].copy(), now)
        assert controller._conditions == one["conditions"], one["tick"]
        assert int(decision.action) == one["action"], one["tick"]
        assert (controller.drive_wanted, controller.enforcement.at_standstill) == (
            one["drive_enable"],
            one["at_standstill"],
        )
        assert (int(result.status), result.flags, result.iterations) == (one["status"], one["flags"], one["iterations"])
        assert np.array_equal(result.u, one["u"][:n]), one["tick"]
    return len(records)


def test_a_run_with_faults_of_every_input_replays_bit_for_bit(arm, rng):
    bench = Bench(arm)
    wish, bad_v = np.zeros(7), np.full(7, np.nan)
    for tick in range(1500):
        if tick % 40 == 0:
            wish = rng.uniform(-0.8, 0.8, 7)
        if tick % 33 == 0:
            bench.show([obstacle(0.6 + 0.1 * np.sin(tick), velocity=(0.1, 0.0, 0.0))] if tick > 100 else [])
        if tick == 900:
            bench.loop.set_speed(0.5)
        spoiled = {250: {"v": bad_v}, 400: {"sequence": bench.sequence}, 470: {"silent": True}}.get(tick, {})
        if 600 <= tick < 630:
            spoiled = {"silent": True}
        if tick in (1200, 1210):
            bench.loop.estop(pressed=tick == 1200)
        if tick in (850, 1240, 1260):
            bench.loop.press(Condition.RESET if tick == 1240 else Condition.RESUME | Condition.CONTINUE)
        late = 1000 <= tick < 1100
        bench.step(None if late else wish + 1e-9 * tick, **spoiled)
    records = bench.loop.read_log()
    assert len(records) == 1500
    assert len(set(records["action"].tolist())) >= 5
    assert replay(records, arm, bench.scenes) == 1500


def test_lost_commands_are_continued_as_the_safety_controller_does_bit_for_bit(arm, rng):
    bench, wish = Bench(arm), np.zeros(7)
    executed, change = np.zeros(7), np.zeros(7)
    for tick in range(1200):
        if tick % 50 == 0:
            wish = rng.uniform(-0.8, 0.8, 7)
            bench.show([obstacle(0.6)] if tick > 300 else [])
        lost = rng.uniform() < 0.3
        if lost:  # the arm continues with its last acceleration
            executed = np.clip(executed + change, -1.0, 1.0)
        else:
            change, executed = bench.u - executed, bench.u.copy()
        bench.u = executed.copy()
        bench.step(wish + 1e-9 * tick, silent=tick % 97 == 5, desired_v=executed.copy(), desired_a=change / arm.period)
    records = bench.loop.read_log()
    assert records["continued"].sum() > 50
    assert np.abs(records["u"]).max() > 0.2
    assert replay(records, arm, bench.scenes) == 1200


def test_a_standstill_of_the_caller_is_kept_although_an_obstacle_approaches(arm):
    for standstill in (False, True):
        bench = Bench(arm)
        bench.run(0.2, np.zeros(7))
        bench.standstill = standstill
        bench.show(
            [Obstacle("hand", Sphere(0.05), Pose(tuple(np.add(bench.safety.tool(bench.q).position, (0.06, 0.0, 0.0)))))]
        )
        moves = np.abs(bench.run(0.2, np.zeros(7))["u"]).max() > 0.0
        assert moves != standstill


def test_a_standstill_of_the_caller_does_not_stop_a_moving_arm_at_once(arm):
    bench = Bench(arm)
    moving = bench.run(0.3, np.full(7, 0.3))
    bench.standstill = True
    records = bench.run(0.3, np.full(7, 0.3))
    step = np.abs(np.diff([moving["u"][-1, :7], *records["u"][:, :7]], axis=0)).max(axis=0)
    assert (step <= [joint.acceleration.value * arm.period * 1.01 for joint in arm.joints]).all()
    assert not records["u"][-1].any()
    assert records["action"].max() < SafetyAction.SLOW


def test_a_caller_that_hangs_ends_in_a_stop_with_the_drive_off(arm):
    bench = Bench(arm, caller_lost_after=0.3)
    for _ in range(round(0.5 / PERIOD)):  # it has not begun yet
        bench.step(np.full(7, 0.2))
    assert bench.drive
    bench.run(0.2, np.full(7, 0.2))
    for _ in range(round(0.28 / PERIOD)):
        bench.step(np.full(7, 0.2))
    assert bench.drive
    for _ in range(round(0.3 / PERIOD)):
        bench.step(np.full(7, 0.2))
    assert not bench.drive
    assert bench.loop.read_log()["action"][-1] == SafetyAction.CONTROLLED_STOP
    assert not bench.loop.take_conditions() & int(Condition.TICK_LOST)  # the caller knows by itself that it was late


def test_the_conditions_that_the_loop_detects_are_taken_once(arm):
    bench = Bench(arm)
    bench.run(0.1, np.zeros(7))
    bench.loop.hold(Condition.ABORT)
    bench.step(np.zeros(7), v=np.full(7, np.nan))
    for _ in range(5000):  # longer than the log
        bench.step(np.zeros(7))
    found = bench.loop.take_conditions()
    assert found & int(Condition.STATE_IMPLAUSIBLE)
    assert not found & int(Condition.ABORT)
    assert not bench.loop.take_conditions()


def test_a_drive_that_the_caller_switches_off_is_no_fault_and_comes_back(arm):
    bench, wish = Bench(arm), np.full(7, 0.2)
    bench.run(0.3, wish)
    bench.loop.set_drive(on=False)
    records = bench.run(0.3, wish)
    assert not records["drive_enable"].any()
    assert not records["u"].any()
    assert records["action"].max() < SafetyAction.SLOW
    bench.loop.set_drive(on=True)
    records = bench.run(0.4, wish)
    assert records["drive_enable"].all()
    assert np.abs(records["u"][-1]).max() > 0.1
    step = np.abs(np.diff(records["u"][:, :7], axis=0)).max(axis=0)
    assert (step <= [joint.acceleration.value * arm.period * 1.01 for joint in arm.joints]).all()


def test_a_drive_that_does_not_come_back_is_a_fault(arm):
    bench = Bench(arm)
    bench.run(0.1, np.zeros(7))
    bench.loop.set_drive(on=False)
    bench.run(0.1, np.zeros(7))
    bench.loop.set_drive(on=True)
    records = bench.run(0.5, np.zeros(7), drive_enabled=False)
    assert first(records, SafetyAction.ESTOP) == pytest.approx(0.3, abs=0.005)


def test_the_control_is_zero_until_a_drive_that_is_switched_on_has_come_on(arm):
    """The control would be at full speed when the drive comes on; loop and controller agree."""
    bench = Bench(arm)
    bench.run(0.1, np.zeros(7))
    bench.loop.set_drive(on=False)
    bench.run(0.1, np.zeros(7), drive_enabled=False)
    bench.loop.set_drive(on=True)
    waiting = bench.run(0.2, np.full(7, 0.2), drive_enabled=False)
    assert waiting["drive_enable"].all()
    assert not waiting["u"].any()
    on = bench.run(0.2, np.full(7, 0.2))
    step = [joint.acceleration.value * arm.period * 1.01 for joint in arm.joints]
    assert (np.abs(on["u"][0, :7]) <= step).all()
    assert (on["u"][-1, :7] > 0.1).all()


@pytest.mark.parametrize("name", ["panda", "ur5e"])
def test_the_control_of_a_controller_is_zero_until_the_drive_has_come_on(name):
    model = load_robot(name)
    controller, state = SafetyController(SafetyFilter(model)), replace(home_state(model), drive_enabled=False)
    controller.safety.observe((), 0.0)
    controller.expect_drive_on(state, 0.0)
    for tick in range(1, 200):
        now = 1e-3 * tick
        state = replace(state, stamp=now, sequence=tick, drive_enabled=tick >= 150)
        controller.accept_state(state, now)
        controller.decide(state, now)
        u = controller.control(state, np.full(model.n, 0.2), now).u
        assert bool(u.any()) == state.drive_enabled, tick
        if tick == 150:
            step = [joint.acceleration.value * model.period * 1.01 for joint in model.joints]
            assert (np.abs(u) <= step).all()


@pytest.mark.parametrize(("silence", "stopped"), [(0.3, False), (0.6, True)])
def test_a_robot_may_be_silent_while_its_drive_is_being_switched_on(arm, silence, stopped):
    bench = Bench(arm, FRANKA)
    bench.run(0.1, np.zeros(7))
    bench.loop.set_drive(on=False)
    bench.run(0.1, np.zeros(7), drive_enabled=False)
    bench.loop.set_drive(on=True)
    records = bench.run(silence, np.zeros(7), silent=True)
    assert (records["action"].max() >= SafetyAction.CONTROLLED_STOP) == stopped


def first(records, action):
    """Time from the first record until the first one with at least this action [s]."""
    hit = np.flatnonzero(records["action"] >= int(action))
    assert len(hit), f"{action.name} was not reached"
    return (int(records["now_us"][hit[0]]) - int(records["now_us"][0])) / 1e6


FAULTS = {
    "velocity_nan": ({"v": np.full(7, np.nan)}, SafetyAction.CONTROLLED_STOP, 0.002),
    "position_out_of_range": ({"q": np.full(7, 9.0)}, SafetyAction.CONTROLLED_STOP, 0.002),
    "silent": ({"silent": True}, SafetyAction.CONTROLLED_STOP, 0.055),
    "silent_for_longer": ({"silent": True}, SafetyAction.ESTOP, 0.155),
    "frozen": ({"sequence": 1}, SafetyAction.CONTROLLED_STOP, 0.055),
    "drive_off": ({"drive_enabled": False}, SafetyAction.ESTOP, 0.004),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_bad_measurements_reach_the_declared_action_within_the_declared_time(arm, fault):
    changes, action, limit = FAULTS[fault]
    bench = Bench(arm)
    assert bench.run(0.15, np.full(7, 0.2))["action"].max() < SafetyAction.SLOW or fault
    records = bench.run(0.3, np.full(7, 0.2), **changes)
    assert first(records, action) <= limit
    assert np.abs(records["u"][-1]).max() < 0.01
    assert np.isfinite(records["u"]).all()


def test_without_a_new_nominal_control_the_arm_holds_and_moves_again_with_one(arm):
    bench = Bench(arm)
    assert np.abs(bench.run(0.3, np.full(7, 0.2))["u"][-1]).max() > 0.1
    records = bench.run(0.5)
    assert first(records, SafetyAction.HOLD) <= 0.052
    assert not records["u"][-1].any()
    assert np.abs(bench.run(0.4, np.full(7, 0.2))["u"][-1]).max() > 0.1


def test_a_control_that_is_not_finite_is_refused_and_the_former_one_remains(arm):
    bench = Bench(arm)
    bench.run(0.3, np.full(7, 0.2))
    assert not bench.loop.submit_control([np.nan] * 7)
    bench.step()
    assert bench.loop.read_log()["control_number"][-1] < bench.loop._controls
    assert bench.loop.status().refused == 1


def test_no_motion_without_a_usable_scene_and_no_command_before_a_state(arm):
    bench = Bench(arm)
    for _ in range(20):
        bench.step(np.full(7, 0.2), silent=True)
    assert not bench.u.any()
    assert bench.loop.read_log()["status"].max() == 0
    bench.run(0.3, np.full(7, 0.2))
    bench.show([obstacle(0.9, velocity=(0.1, 0.0, 0.0))])
    assert first(bench.run(0.7, np.full(7, 0.2)), SafetyAction.HOLD) <= 0.56


def test_an_emergency_stop_latches_until_its_release_and_a_reset(arm):
    bench, wish = Bench(arm), np.full(7, 0.2)
    bench.run(0.2, wish)
    bench.loop.estop()
    records = bench.run(0.4, wish)
    assert records["action"].min() == SafetyAction.ESTOP
    assert not records["drive_enable"].any()
    bench.loop.press(Condition.RESET)
    assert bench.run(0.1, wish)["action"].min() == SafetyAction.ESTOP
    bench.loop.estop(pressed=False)
    assert bench.run(0.1, wish)["action"].min() == SafetyAction.ESTOP
    bench.loop.press(Condition.RESET)
    assert bench.run(0.1, wish)["action"][-1] == SafetyAction.HOLD
    bench.loop.press(Condition.RESUME)
    assert np.abs(bench.run(0.4, wish)["u"][-1]).max() > 0.1


def test_a_log_that_is_not_read_drops_records_and_never_stops_the_loop(arm):
    bench = Bench(arm)
    for _ in range(4200):
        bench.step(np.zeros(7))
    assert bench.loop.status().log_dropped == 104
    records = bench.loop.read_log()
    assert records["tick"].tolist() == list(range(1, 4097))


def test_the_thread_runs_the_simulated_arm_and_brings_it_to_rest_at_its_end(arm):
    safety = SafetyFilter(arm)
    thread = ControlThread(safety, simulated_at=HOME)
    status = thread.start()
    assert status.running
    assert status.real_time or "rtprio" in status.warnings[0]
    for _ in range(20):
        thread.submit_control(np.full(7, 0.2))
        time.sleep(0.005)
    thread.stop()
    records = thread.read_log()
    assert thread.status().finished
    assert records["u"].max() > 0.0
    assert not records["drive_enable"][-1]
    assert not np.abs(records["u"][-1]).any()


def test_a_robot_that_the_loop_cannot_supervise_is_refused(arm, sparse_panda):
    with pytest.raises(ConfigurationError, match="priority"):
        ControlThread(SafetyFilter(arm), ControlThreadConfig(priority=100))
    with pytest.raises(ConfigurationError, match="control_valid"):
        ControlThread(SafetyFilter(arm), ControlThreadConfig(control_valid=float("nan")))
    with pytest.raises(ConfigurationError, match="caller_lost_after"):
        ControlThread(SafetyFilter(arm), ControlThreadConfig(caller_lost_after=0.01))
    with pytest.raises(ConfigurationError, match="force sensing"):
        ControlThread(SafetyFilter(sparse_panda))
    ControlThread(SafetyFilter(sparse_panda), ControlThreadConfig(forces_supervised=True))
