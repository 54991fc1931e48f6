"""The supervisor's decisions on the simulated arm: reactions to operators, drives, sensors and the filter."""

from dataclasses import replace

import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.control_loop import ControlLoopConfig, LoopInputs, LoopObserver
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.assembly import SimulatedCell
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.world import SimulatedWorld

MODEL = load_robot("panda")
GRASP = {
    "object": "red_cube",
    "speed": 0.3,
    "clearance": 0.15,
    "finger_axis": "along",
    "opening": 0.08,
    "approach": "top",
    "wait": "none",
    "force": 20.0,
}
C = Condition


class SupervisedCell:
    """A simulated arm in a bare scene; `conditions(t)` are the external `Condition` bits at the time `t` [s]."""

    def __init__(self, conditions=lambda t: 0, speed_scale=1.0, robot=lambda plant: plant):
        spec = open_scene("bare:0")
        self.plant = Plant(spec, MODEL)
        self.world = SimulatedWorld(self.plant, NoisyPerception(spec, PerceptionNoise(), np.random.default_rng([0, 1])))
        cell = SimulatedCell(
            MODEL,
            self.world,
            config=ControlLoopConfig(settle_time=0.8),
            inputs=LoopInputs(
                external_conditions=lambda: int(conditions(self.plant.now)), clock=lambda: self.plant.now
            ),
            robot=robot(self.plant),
        )
        self.executor, self.loop, self.trace = cell.executor, cell.loop, cell.log.trace
        self.loop.safety_controller.speed_scale = speed_scale

    def grasp(self):
        return self.executor.execute(Contract("c-1", Context("panda", ""), (Action("grasp", GRASP),)))

    @property
    def decision(self):
        return self.loop.safety_controller.decision

    def tripped_checks(self):
        return [e.data["check"] for e in self.trace.events if e.kind == "order" and "check" in e.data]

    def has_no_violations(self):
        return self.world.judgement().violations == ()


def between(flag, start, end=99.0):
    return lambda t: flag if start <= t < end else 0


def test_without_conditions_the_supervisor_changes_nothing():
    cell = SupervisedCell()
    assert cell.grasp().kind == "succeeded"
    assert cell.tripped_checks() == []
    assert not np.any(cell.trace["delta_supervisor"])
    assert np.all(cell.trace["touched"] == 1.0)


def test_a_pause_waits_and_the_contract_continues_after_it():
    cell = SupervisedCell(between(C.PAUSE, 1.0, 7.0))
    outcome = cell.grasp()
    assert outcome.kind == "paused"
    assert outcome.r == 0
    paused = (cell.trace["t"] > 1.5) & (cell.trace["t"] < 7.0)
    assert np.abs(cell.trace["v"][paused]).max() < 0.01
    assert cell.tripped_checks()[:2] == ["paused", ""]
    assert cell.has_no_violations()


def test_a_nominal_control_that_is_scaled_to_zero_is_a_positive_zero(monkeypatch):
    """A target sets it to 0; −0 has another bit and would be a difference between target and host."""
    cell, scaled = SupervisedCell(between(C.ABORT, 1.0)), []
    filter_control = cell.loop.safety.filter

    def observed(state, u_nom, now):
        scaled.append(u_nom)
        return filter_control(state, u_nom, now)

    monkeypatch.setattr(cell.loop.safety, "filter", observed)
    assert cell.grasp().kind == "aborted"
    zeros = [u for u in scaled if not u.any()]
    assert len(zeros) > 50
    assert not np.signbit(zeros).any()


def test_the_cell_passes_on_every_callback_of_an_observer():
    seen = []
    world = SupervisedCell().world
    observer = LoopObserver(
        on_tick=lambda snapshot: seen.append("tick"),
        on_phase=lambda phase, roles: seen.append("phase"),
        mark_part=lambda part: seen.append("part"),
        on_result=lambda result, action, *, in_contract: seen.append("result"),
    )
    cell = SimulatedCell(MODEL, world, observer=observer)
    cell.loop.hold(0.1)
    assert set(seen) == {"tick", "phase", "part", "result"}
    assert seen.count("result") == 100


def test_a_speed_stage_slows_the_whole_contract_and_patience_with_it():
    usual, slow = SupervisedCell(), SupervisedCell(speed_scale=0.5)
    fast, outcome = usual.grasp(), slow.grasp()
    assert (fast.kind, outcome.kind) == ("succeeded", "slowed")
    assert np.abs(slow.trace["v"]).max() < 0.6 * np.abs(usual.trace["v"]).max()
    share = slow.trace["delta_supervisor"] / np.maximum(slow.trace["delta"], 1e-12)
    assert np.median(share[slow.trace["delta"] > 1e-3]) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("flag", "kind", "action", "drive"),
    [
        (C.ABORT, "aborted", SafetyAction.HOLD, True),
        (C.TAKEOVER, "handed_over", SafetyAction.HOLD, True),
        (C.LINK_LOST, "stopped", SafetyAction.HOLD, True),
        (C.HEARTBEAT_LOST, "stopped", SafetyAction.HOLD, True),
        (C.INTERRUPT, "aborted", SafetyAction.CONTROLLED_STOP, False),
        (C.CLOCK_STEP, "stopped", SafetyAction.CONTROLLED_STOP, False),
        (C.ESTOP, "emergency", SafetyAction.ESTOP, False),
    ],
)
def test_a_condition_that_ends_a_contract_stops_the_arm_and_sets_the_drive(flag, kind, action, drive):
    cell = SupervisedCell(between(flag, 1.0))
    outcome = cell.grasp()
    assert outcome.kind == kind
    assert cell.decision.action is action
    assert cell.executor.state.drive_enabled is drive
    assert np.abs(cell.executor.state.v).max() < 0.01
    assert cell.has_no_violations()
    tick = int(np.searchsorted(cell.trace["t"], 1.0))
    assert abs(cell.trace["t"][tick] - 1.0) < 2e-3
    assert cell.trace["order"][tick + 1] == action, "a decision takes effect in the tick of its condition"


def test_a_reset_after_an_emergency_stop_ends_in_a_hold_with_the_drive_on():
    def conditions(t):
        return C.ESTOP if 1.0 <= t < 1.2 else C.RESET if 2.5 <= t < 2.6 else C.RESUME if 3.0 <= t < 3.1 else 0

    cell = SupervisedCell(conditions)
    assert cell.grasp().kind == "emergency"
    cell.executor.hold(2.4 - cell.plant.now)
    assert not cell.executor.state.drive_enabled
    cell.executor.hold(2.8 - cell.plant.now)
    assert (cell.decision.action, cell.executor.state.drive_enabled) == (SafetyAction.HOLD, True)
    cell.executor.hold(0.5)
    assert cell.decision.action is SafetyAction.NONE
    assert np.abs(cell.executor.state.v).max() < 0.01
    assert cell.has_no_violations()


class FaultyRobot:
    """A robot whose states or commands are wrong from the time `since` [s] on."""

    def __init__(self, plant, since=1.0, state=lambda s, since: s, command=lambda c: c):
        self._plant, self._since, self._state, self._command = plant, since, state, command

    def read(self):
        state = self._plant.read()
        return self._state(state, self._since) if self._plant.now > self._since else state

    def write(self, command):
        self._plant.write(self._command(command) if self._plant.now > self._since else command)

    def stop(self):
        self._plant.stop()

    def enable(self):
        self._plant.enable()


def faulty_robot(**changes):
    return lambda plant: FaultyRobot(plant, **changes)


def frozen_state():
    states = []

    def state(s, since):
        states.append(s)
        return states[0]

    return state


STATES = {
    "no new state": (frozen_state(), {"state_stale", "state_lost"}),
    "not a number": (lambda s, since: replace(s, q=s.q * np.nan), {"state_implausible", "state_lost"}),
    "a jump": (lambda s, since: replace(s, q=s.q + 0.05), {"state_implausible"}),
    "velocity stuck": (lambda s, since: replace(s, v=s.v * 0.0), {"sources_disagree"}),
    "creeping away": (
        lambda s, since: replace(s, q=s.q + 0.15 * (s.stamp - since)),
        {"sources_disagree", "tracking_off"},
    ),
    "stamps of another clock": (lambda s, since: replace(s, stamp=s.stamp + 1.0), {"clock_step"}),
}


@pytest.mark.parametrize("name", STATES)
def test_an_implausible_joint_state_stops_the_arm(name):
    state, checks = STATES[name]
    cell = SupervisedCell(robot=faulty_robot(state=state))
    outcome = cell.grasp()
    assert outcome.kind in ("stopped", "emergency"), outcome.reason
    assert checks & set(cell.tripped_checks())
    assert not cell.plant.read().drive_enabled
    assert np.abs(cell.plant.read().v).max() < 0.01
    assert cell.has_no_violations()


def test_a_drive_that_does_not_follow_is_switched_off():
    cell = SupervisedCell(robot=faulty_robot(command=lambda c: replace(c, u=c.u * 0.0)))
    outcome = cell.grasp()
    assert outcome.kind in ("stopped", "emergency")
    assert {"tracking_off", "tracking_lost"} & set(cell.tripped_checks())
    assert not cell.plant.read().drive_enabled


def test_a_drive_that_switches_itself_off_is_an_emergency():
    cell = SupervisedCell()
    cell.executor.hold(0.1)
    cell.plant.stop()
    cell.executor.hold(0.1)
    assert cell.decision.check == "drive_dropped"


def test_brakes_that_do_not_hold_lock_the_robot_out():
    cell = SupervisedCell(between(C.ESTOP, 0.5))
    engage_brakes = cell.plant.stop

    def engage_weak_brakes():
        engage_brakes()
        cell.plant.model.dof_frictionloss[cell.plant.arm_slices[1]] = 0.5  # too little against gravity

    cell.plant.stop = engage_weak_brakes
    cell.executor.hold(1.5)
    assert cell.decision.action is SafetyAction.LOCKOUT
    assert cell.decision.check == "falling"


def test_motion_during_a_monitored_standstill_is_an_emergency():
    cell = SupervisedCell(between(C.ABORT, 0.2))
    cell.executor.hold(0.5)
    assert cell.decision.action is SafetyAction.HOLD
    write = cell.plant.write
    cell.plant.write = lambda command: write(replace(command, u=command.u + 0.05))  # the drive creeps
    cell.executor.hold(0.5)
    assert "drift" in cell.tripped_checks() or "tracking_off" in cell.tripped_checks()
    assert not cell.plant.read().drive_enabled


def test_a_filter_that_returns_nan_is_replaced_by_braking():
    cell = SupervisedCell()
    filter_control = cell.loop.safety.filter

    def broken_filter(*arguments, **others):
        result = filter_control(*arguments, **others)
        if cell.plant.now > 1.0:
            result.u[:] = np.nan
        return result

    cell.loop.safety.filter = broken_filter
    outcome = cell.grasp()
    assert outcome.kind == "stopped"
    assert "control_bad" in cell.tripped_checks()
    assert np.isfinite(cell.trace["u"]).all()
    late = cell.trace["t"] > 1.0
    assert np.abs(np.diff(cell.trace["u"][late], axis=0)).max() < 0.03, "braking respects the acceleration limits"
    assert cell.has_no_violations()
