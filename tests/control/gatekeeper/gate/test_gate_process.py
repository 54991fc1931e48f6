"""The gate process: the verdicts of the gate itself, failures of the process, and the time that it costs a tick."""

import os
import signal
import time

import msgspec
import numpy as np
import pytest

from dualbrain.contracts.contract import ContractHeader
from dualbrain.contracts.verdict import Accepted, Rejected
from dualbrain.control.gatekeeper.capability import full_capability
from dualbrain.control.gatekeeper.gate.exchange import GateRequest, GateSetup, gate_failure
from dualbrain.control.gatekeeper.gate.gate_process import CHECK_TIMEOUT, GateProcess
from dualbrain.control.gatekeeper.gate.inline_gate import InlineGate
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.skills.registry import skill_registry
from experiments.gatekeeper.commander_messages import contract_bytes
from experiments.interfaces.worst_contracts import worst_contracts

PLANNER = "planner"
MODEL = load_robot("panda")
SCENE = scene_from_spec(open_scene("bare:0"))
SETUP = GateSetup(robot_model=MODEL, capabilities={PLANNER: full_capability(skill_registry(MODEL))})
UNDISTURBED_TICKS = 200
LARGEST_EXTRA_TIME = 2e-3
"""Largest processor time that a contract may add to a tick of the control process [s]."""


class Clock:
    """A clock that a test can advance; otherwise the time of the machine."""

    def __init__(self):
        self.offset = 0.0

    def __call__(self):
        return time.monotonic() + self.offset


@pytest.fixture(scope="module")
def clock():
    return Clock()


@pytest.fixture(scope="module")
def gate(clock):
    gate = GateProcess(SETUP, clock)
    gate.wait_until_ready()
    yield gate
    gate.close()


def make_request(contract, number):
    q = np.array(MODEL.home)
    state = RobotState(stamp=0.0, sequence=1, q=q, v=np.zeros(MODEL.n), opening=0.04, finger_forces=(0.0, 0.0))
    stamp = ContractHeader(sequence=number, issued=0.0, expires=60.0, principal=PLANNER, scene_version=SCENE.version)
    return GateRequest(
        connection_number=1,
        sequence=number,
        contract=contract,
        stamp=stamp,
        now=1.0,
        scene=SCENE,
        state=state,
        holding=None,
    )


def wait_for_reply(gate):
    deadline = time.monotonic() + 120.0
    while (reply := gate.take_reply()) is None:
        assert time.monotonic() < deadline
        time.sleep(0.001)
    assert not gate.busy
    return reply


def check(gate, contract, number):
    request = make_request(contract, number)
    assert gate.submit(request)
    assert gate.busy
    assert not gate.submit(request)
    reply = wait_for_reply(gate)
    assert reply.request is request
    return reply.verdict


VALID = contract_bytes()


def test_the_process_gives_the_verdicts_of_the_gate(gate):
    inline = InlineGate(SETUP)
    contracts = [VALID, *worst_contracts(skill_registry(MODEL), n_random=20).values(), b"", b"\xff", VALID[:-5]]
    verdicts = []
    for number, contract in enumerate(contracts, 1):
        here, there = check(inline, contract, number), check(gate, contract, number)
        assert msgspec.to_builtins(here) == msgspec.to_builtins(there)
        verdicts.append(there)
    assert isinstance(verdicts[0], Accepted)
    assert all(isinstance(verdict, Rejected) for verdict in verdicts[1:])


def test_a_contract_is_rejected_if_the_process_dies_while_checking_and_the_next_one_is_checked(gate):
    os.kill(gate.process.pid, signal.SIGSTOP)
    dead = gate.process
    assert gate.submit(make_request(VALID, 100))
    dead.kill()
    verdict = wait_for_reply(gate).verdict
    assert isinstance(verdict, Rejected)
    assert verdict.hint == "the gate failed"
    assert dead.returncode == -signal.SIGKILL
    assert isinstance(check(gate, VALID, 101), Accepted)


def test_a_failure_of_the_gate_is_reported_in_bounded_printable_text():
    got = gate_failure(f"ValueError: c-1\n\x1b[31m{'x' * 10_000}").got
    assert got.startswith(r"ValueError: c-1\n\x1b[31mxxx")
    assert len(got) < 300


def test_a_process_that_died_while_idle_is_replaced_before_the_next_contract(gate):
    gate.process.kill()
    gate.process.wait()
    assert isinstance(check(gate, VALID, 110), Accepted)


def test_a_check_that_takes_too_long_is_a_rejection_and_the_next_one_is_checked(gate, clock):
    check(gate, VALID, 120)
    stuck = gate.process
    os.kill(stuck.pid, signal.SIGSTOP)
    assert gate.submit(make_request(VALID, 121))
    assert gate.take_reply() is None
    clock.offset += CHECK_TIMEOUT + 0.1
    verdict = wait_for_reply(gate).verdict
    assert isinstance(verdict, Rejected)
    assert "took longer" in verdict.got
    assert stuck.returncode == -signal.SIGKILL
    assert isinstance(check(gate, VALID, 122), Accepted)


def test_the_process_ends_with_the_control_process(clock):
    gate = GateProcess(SETUP, clock)
    gate.wait_until_ready()
    gate._socket.close()
    assert gate.process.wait(timeout=60.0) == 0


@pytest.mark.skipif(not hasattr(os, "SCHED_FIFO"), reason="the system has no real-time priorities")
def test_the_process_has_no_real_time_priority(gate, clock):
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    except PermissionError:
        pytest.skip("this user may not request a real-time priority")
    try:
        child = GateProcess(SETUP, clock)
        os.sched_setscheduler(0, *before)
        child.wait_until_ready()
        assert os.sched_getscheduler(child.process.pid) == os.SCHED_OTHER
        child.close()
    finally:
        os.sched_setscheduler(0, *before)


def longest_tick(gate, contracts):
    """Largest processor time of this process from one tick of a control loop to the next [s], beside `contracts`."""
    safety = SafetyFilter(MODEL)
    q, v, u = np.array(MODEL.home), np.zeros(MODEL.n), np.full(MODEL.n, 0.1)
    waiting, times, number = list(contracts), [], 1000
    while waiting or gate.busy or len(times) < UNDISTURBED_TICKS:
        start = time.process_time()
        safety(q, v, u)
        if waiting and not gate.busy:
            number += 1
            gate.submit(make_request(waiting.pop(), number))
        gate.take_reply()
        time.sleep(1e-3)
        times.append(time.process_time() - start)
    return max(times[10:])


def test_no_contract_adds_two_milliseconds_to_a_tick(gate):
    """Processor time of the whole process, from tick to tick: a thread that keeps the interpreter would show."""
    worst = list(worst_contracts(skill_registry(MODEL), n_random=30, seed=1).values())
    undisturbed = min(longest_tick(gate, []) for _ in range(3))
    extra = min(longest_tick(gate, worst) for _ in range(3)) - undisturbed
    assert extra < LARGEST_EXTRA_TIME
