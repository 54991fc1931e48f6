"""Counts of all ticks: equal to an independent count from the recording of a run; invalid reports are refused."""

from concurrent.futures import ThreadPoolExecutor

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
from dualbrain.control.gatekeeper.protocol.frames import Frame
from dualbrain.control.gatekeeper.protocol.messages import CountsReport, decode_message, encode_body, kind_code
from dualbrain.control.gatekeeper.timing.tick_counts import (
    CLEARANCE_BOUNDS,
    CONSTRAINT_KINDS,
    DELTA_BOUNDS,
    LENGTHS,
    OUTCOMES,
    VERDICTS,
    TickCounter,
)
from dualbrain.control.recording.channels import read_trace
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.trace import DEAD_BAND, Trace
from dualbrain.evaluation.fault_injection.faults import Fault, FaultInjector
from dualbrain.evaluation.fault_injection.faulty_client import FaultyCommander
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.result import PACKED_ROW, FilterResult, FilterStatus, RowNames
from dualbrain.safety.supervisor.actions import SafetyAction
from experiments.gatekeeper.commander_messages import GRASP, contract_bytes
from tests.control.gatekeeper.lockstep_cell import make_cell

BRIEF_HOLD = ("hold", {"duration": 0.5})
NEAR_SHELF = ("grasp", {**GRASP, "clearance": 0.05})
REQUEST_TIME = 2.6
"""Robot time of the request for the counts [s]."""
NAMES = RowNames(
    spheres=("link", "hand"),
    obstacles=("cup",),
    joints=("j1",),
    v_max=(1.0,),
    barriers=("obstacle",),
    rows=("mine: x",),
)
KINDS_OF_BARRIERS = {
    "obstacle": "obstacle",
    "self_collision": "self_collision",
    "joint_limits": "control_bound",
    "joint_motion": "control_bound",
    "mine": "extra_row",
    "cartesian_speed": "speed_limit",
}


def make_result(*, delta=0.0, h_min=0.1, status=FilterStatus.SAFE, rows=()):
    packed = b"".join(PACKED_ROW.pack(kind, 0, 0, 0.0, 1.0) for kind in rows)
    u = np.zeros(1)
    return FilterResult(u, u, NAMES, status, 0, delta, delta, 0.0, h_min, True, 1, len(rows), packed)


@pytest.fixture(scope="module")
def observed(tmp_path_factory):
    """The counts that an observer got, the recorded ticks until then, and the outcomes.

    One contract was rejected, a second one succeeded, and a third one, near a shelf, was running.
    """
    folder, robot_model = tmp_path_factory.mktemp("counts"), load_robot("panda")
    trace, outcomes, commanders, requests = Trace(robot_model.n, robot_model.nq), [], [], []
    no_fault = FaultInjector(Fault("state", "off", "closing"), lambda: 0.0)
    contracts = [(0.1, b"not a contract"), (0.2, contract_bytes(BRIEF_HOLD)), (1.6, contract_bytes(NEAR_SHELF))]
    path = folder / "ticks.mcap"

    def on_period(now):
        if contracts and now > contracts[0][0]:
            for commander in commanders:
                commander.close()
            text = contracts.pop(0)[1]
            commanders[:] = [FaultyCommander(cell.socket, cell.keys, "planner", no_fault, text, text)]
        if commanders:
            commanders[-1].step(now)
        if now > REQUEST_TIME and observer.done() and not requests:
            requests.append(background.submit(observer.result().request_counts))
        if requests and requests[0].done():
            cell.gatekeeper.shut_down()

    with ThreadPoolExecutor() as background, Recorder(path, trace, when_full="wait") as recorder:
        options = {"recorder": recorder, "trace": trace, "on_outcome": outcomes.append}
        cell = make_cell(folder, "shelf_ii:0", on_period=on_period, robot_time=True, **options)
        observer = background.submit(GatekeeperClient, cell.socket)
        cell.gatekeeper.run()
        cell.server.close()
        for client in (observer.result(), *commanders):
            client.close()
    counts, recorded = requests[0].result(), read_trace(path)
    return counts, {name: recorded[name][: counts.ticks] for name in recorded.columns}, outcomes[:1]


def bins(values, bounds):
    """The number of values in each bin, with the upper bounds included."""
    below = [int(np.count_nonzero(np.asarray(values) <= bound)) for bound in (*bounds, np.inf)]
    return tuple(np.diff([0, *below]).tolist())


def by_code(values, codes):
    return tuple(np.bincount(values.astype(int), minlength=len(codes)).tolist())


def test_every_tick_of_a_run_is_counted_once(observed):
    counts, ticks, _ = observed
    assert counts.ticks == len(ticks["t"]) > 1000
    assert counts.contract_ticks == np.count_nonzero(ticks["action"] >= 0) > 500
    assert counts.filter_status == by_code(ticks["status"], FilterStatus)
    assert counts.actions == by_code(ticks["order"], SafetyAction)
    assert counts.interventions == np.count_nonzero(ticks["delta"] > DEAD_BAND) > 0
    assert (counts.late, counts.missed) == (0, 0)


def test_the_histograms_are_those_of_the_recorded_ticks(observed):
    counts, ticks, _ = observed
    for name, column, bounds in (("delta", "delta", DELTA_BOUNDS), ("clearance", "h_min", CLEARANCE_BOUNDS)):
        assert getattr(counts, name) == bins(ticks[column], bounds)
        assert getattr(counts, f"{name}_sum") == pytest.approx(ticks[column].sum())
    assert np.count_nonzero(counts.delta) > 2
    assert counts.h_min == ticks["h_min"][-1]


def test_verdicts_and_outcomes_are_counted(observed):
    counts, _, outcomes = observed
    assert dict(zip(VERDICTS, counts.verdicts, strict=True)) == dict.fromkeys(VERDICTS, 0) | {
        "accepted": 2,
        "rejected_syntax": 1,
    }
    assert dict(zip(OUTCOMES, counts.outcomes, strict=True)) == dict.fromkeys(OUTCOMES, 0) | {"succeeded": 1}
    assert [outcome.kind for outcome in outcomes] == ["succeeded"]


@given(st.lists(st.lists(st.integers(0, 5), max_size=4), max_size=6))
def test_a_kind_of_constraint_counts_once_for_each_tick_in_which_it_was_binding(ticks):
    counter, expected = TickCounter(), dict.fromkeys(CONSTRAINT_KINDS, 0)
    for rows in ticks:
        result = make_result(rows=rows)
        counter.count_tick(result, SafetyAction.NONE, in_contract=True)
        for kind in {KINDS_OF_BARRIERS[name] for name in result.barriers}:
            expected[kind] += 1
    assert dict(zip(CONSTRAINT_KINDS, counter.counts(0, 0).binding, strict=True)) == expected


@given(st.lists(st.floats(0.0, 2.0) | st.sampled_from((float("nan"), float("inf"), *DELTA_BOUNDS)), max_size=20))
def test_a_delta_that_is_not_a_number_counts_as_an_intervention_of_the_largest_size(values):
    counter = TickCounter()
    for value in values:
        counter.count_tick(make_result(delta=value, h_min=value), SafetyAction.HOLD, in_contract=False)
    counts = counter.counts(3, 4)
    assert sum(counts.delta) == counts.ticks == len(values)
    assert counts.interventions == sum(not value <= DEAD_BAND for value in values) == len(values) - counts.delta[0]
    assert counts.clearance == bins([value for value in values if np.isfinite(value)], CLEARANCE_BOUNDS)
    assert np.isfinite([counts.delta_sum, counts.clearance_sum]).all()
    assert (counts.late, counts.missed, counts.contract_ticks) == (3, 4, 0)


REPORT = msgspec.to_builtins(CountsReport(TickCounter().counts(0, 0)))
CODE = kind_code(CountsReport(TickCounter().counts(0, 0)))


def decoded(**changes):
    report = {"counts": {**REPORT["counts"], **changes}}
    return decode_message(Frame(CODE, 1, msgspec.msgpack.encode(report)), from_client=False)


@pytest.mark.parametrize("name", LENGTHS)
def test_a_report_with_another_number_of_counts_is_refused(name):
    assert isinstance(decoded(), CountsReport)
    assert "counts, expected" in decoded(**{name: (0,) * (LENGTHS[name] + 1)})
    assert "counts, expected" in decoded(**{name: ()})


@pytest.mark.parametrize("changes", [{"ticks": -1}, {"ticks": "many"}, {"binding": [-1, 0, 0, 0, 0]}, {"more": 0}])
def test_a_report_with_another_content_is_refused(changes):
    assert decoded(**changes).startswith(f"kind {CODE}: ")


def test_a_report_survives_the_socket():
    report = CountsReport(TickCounter().counts(1, 2))
    assert decode_message(Frame(CODE, 1, encode_body(report)), from_client=False) == report
