"""The supervisor's orders on the simulated arm: what a person, a drive or a sensor does, and what becomes of it."""

from dataclasses import replace

import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopInputs, LoopObserver
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.world import SimulatedWorld

BODY = load_robot("panda")
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


class Rig:
    """A bare scene, and a hand at the operator's panel: `asks(t)` gives `Condition` bits, by time [s]."""

    def __init__(self, asks=lambda t: 0, stage=1.0, robot=lambda plant: plant):
        spec = open_scene("bare:0")
        self.plant = Plant(spec, BODY)
        self.world = SimulatedWorld(self.plant, NoisyPerception(spec, PerceptionNoise(), np.random.default_rng([0, 1])))
        self.log = FlightLog(Trace(BODY.n))
        self.layer = ContractExecutor(
            ControlLoop(
                BODY,
                robot(self.plant),
                self.world,
                SafetyFilter(BODY),
                self.log,
                ControlLoopConfig(settle_time=0.8),
                LoopObserver(on_phase=self.world.set_phase),
                inputs=LoopInputs(external_conditions=lambda: int(asks(self.plant.now)), clock=lambda: self.plant.now),
            )
        )
        self.layer.loop.safety_controller.speed_stage = stage

    def grasp(self):
        return self.layer.execute(Contract("c-1", Context("panda", ""), (Action("grasp", GRASP),)))

    @property
    def trace(self):
        return self.log.trace

    def orders(self):
        return [e.data["check"] for e in self.trace.events if e.kind == "order" and "check" in e.data]

    def unharmed(self):
        return self.world.judgement().violations == ()


def between(flag, start, end=99.0):
    return lambda t: flag if start <= t < end else 0


def test_without_orders_nothing_is_touched():
    rig = Rig()
    assert rig.grasp().kind == "succeeded"
    assert rig.orders() == []
    assert not np.any(rig.trace["delta_supervisor"])
    assert np.all(rig.trace["touched"] == 1.0)


def test_a_pause_waits_and_the_contract_is_finished_after_it():
    rig = Rig(between(C.PAUSE, 1.0, 7.0))
    outcome = rig.grasp()
    assert outcome.kind == "paused"
    assert outcome.r == 0
    waits = (rig.trace["t"] > 1.5) & (rig.trace["t"] < 7.0)
    assert np.abs(rig.trace["v"][waits]).max() < 0.01
    assert rig.orders()[:2] == ["paused", ""]
    assert rig.unharmed()


def test_a_speed_stage_slows_the_whole_contract_and_patience_with_it():
    usual, slow = Rig(), Rig(stage=0.5)
    fast, outcome = usual.grasp(), slow.grasp()
    assert (fast.kind, outcome.kind) == ("succeeded", "slowed")
    assert np.abs(slow.trace["v"]).max() < 0.6 * np.abs(usual.trace["v"]).max()
    share = slow.trace["delta_supervisor"] / np.maximum(slow.trace["delta"], 1e-12)
    assert np.median(share[slow.trace["delta"] > 1e-3]) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("flag", "kind", "rung", "drive"),
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
def test_what_ends_a_contract_stops_the_arm_and_leaves_the_drive_as_ordered(flag, kind, rung, drive):
    rig = Rig(between(flag, 1.0))
    outcome = rig.grasp()
    assert outcome.kind == kind
    assert rig.layer.loop.safety_controller.decision.action is rung
    assert rig.layer.state.drive_enabled is drive
    assert np.abs(rig.layer.state.v).max() < 0.01
    assert rig.unharmed()
    tick = int(np.searchsorted(rig.trace["t"], 1.0))
    assert abs(rig.trace["t"][tick] - 1.0) < 2e-3
    assert rig.trace["order"][tick + 1] == rung, "an order takes effect in the tick in which it is asked for"


def test_after_an_emergency_stop_reset_lands_in_a_hold_with_the_drive_on():
    def asks(t):
        return C.ESTOP if 1.0 <= t < 1.2 else C.RESET if 2.5 <= t < 2.6 else C.RESUME if 3.0 <= t < 3.1 else 0

    rig = Rig(asks)
    assert rig.grasp().kind == "emergency"
    rig.layer.hold(2.4 - rig.plant.now)
    assert not rig.layer.state.drive_enabled
    rig.layer.hold(2.8 - rig.plant.now)
    assert (rig.layer.loop.safety_controller.decision.action, rig.layer.state.drive_enabled) == (
        SafetyAction.HOLD,
        True,
    )
    rig.layer.hold(0.5)
    assert rig.layer.loop.safety_controller.decision.action is SafetyAction.NONE
    assert np.abs(rig.layer.state.v).max() < 0.01
    assert rig.unharmed()


class Bad:
    """A robot whose states or commands go wrong from a moment on."""

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


def bad(**changes):
    return lambda plant: Bad(plant, **changes)


def frozen():
    kept = []

    def state(s, since):
        kept.append(s)
        return kept[0]

    return state


STATES = {
    "no new state": (frozen(), {"state_stale", "state_lost"}),
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
def test_a_joint_state_that_cannot_be_stops_the_arm(name):
    state, checks = STATES[name]
    rig = Rig(robot=bad(state=state))
    outcome = rig.grasp()
    assert outcome.kind in ("stopped", "emergency"), outcome.reason
    assert checks & set(rig.orders())
    assert not rig.plant.read().drive_enabled
    assert np.abs(rig.plant.read().v).max() < 0.01
    assert rig.unharmed()


def test_a_drive_that_does_not_follow_is_switched_off():
    rig = Rig(robot=bad(command=lambda c: replace(c, u=c.u * 0.0)))
    outcome = rig.grasp()
    assert outcome.kind in ("stopped", "emergency")
    assert {"tracking_off", "tracking_lost"} & set(rig.orders())
    assert not rig.plant.read().drive_enabled


def test_a_drive_that_goes_off_unasked_is_an_emergency():
    rig = Rig()
    rig.layer.hold(0.1)
    rig.plant.stop()
    rig.layer.hold(0.1)
    assert rig.layer.loop.safety_controller.decision.check == "drive_dropped"


def test_brakes_that_do_not_hold_lock_out():
    rig = Rig(between(C.ESTOP, 0.5))
    usual = rig.plant.stop

    def slack():
        usual()
        rig.plant.model.dof_frictionloss[rig.plant.arm_slices[1]] = 0.5  # worn: gravity wins

    rig.plant.stop = slack
    rig.layer.hold(1.5)
    assert rig.layer.loop.safety_controller.decision.action is SafetyAction.LOCKOUT
    assert rig.layer.loop.safety_controller.decision.check == "falling"


def test_who_pushes_an_arm_in_a_monitored_standstill_makes_it_an_emergency():
    rig = Rig(between(C.ABORT, 0.2))
    rig.layer.hold(0.5)
    assert rig.layer.loop.safety_controller.decision.action is SafetyAction.HOLD
    usual = rig.plant.write
    rig.plant.write = lambda command: usual(replace(command, u=command.u + 0.05))  # the drive creeps
    rig.layer.hold(0.5)
    assert "drift" in rig.orders() or "tracking_off" in rig.orders()
    assert not rig.plant.read().drive_enabled


def test_a_filter_whose_answer_is_no_number_is_replaced_by_braking():
    rig = Rig()
    usual = rig.layer.loop.safety.filter

    def broken(*arguments, **others):
        answer = usual(*arguments, **others)
        if rig.plant.now > 1.0:
            answer.u[:] = np.nan
        return answer

    rig.layer.loop.safety.filter = broken
    outcome = rig.grasp()
    assert outcome.kind == "stopped"
    assert "control_bad" in rig.orders()
    assert np.isfinite(rig.trace["u"]).all()
    late = rig.trace["t"] > 1.0
    assert np.abs(np.diff(rig.trace["u"][late], axis=0)).max() < 0.03, "braking keeps to the acceleration limits"
    assert rig.unharmed()
