"""Contracts one after another and at once: one motion each, and the newest report comes first."""

import time
from concurrent.futures import ThreadPoolExecutor
from threading import Event

from dualbrain.planner.protocol import STOP
from dualbrain.records import Proposal
from tests.agent_api.stub_client import StubClient, open_robot


def test_a_contract_that_is_run_twice_at_once_moves_once_and_both_get_its_outcome(cell, monkeypatch):
    client = StubClient(cell)
    propose = client.propose

    def propose_slowly(data, scene_version):
        time.sleep(0.3)
        return propose(data, scene_version)

    monkeypatch.setattr(client, "propose", propose_slowly)
    with open_robot(client, cell, monkeypatch) as robot, ThreadPoolExecutor(2) as pool:
        contract = robot.contract([{"skill": "hold", "params": {"duration": 1.0}}], "c-0001")
        reports = [run.result() for run in [pool.submit(robot.run, contract) for _ in range(2)]]
    assert client.executed == ["c-0001"]
    assert [one.succeeded for one in reports] == [True, True]
    assert sorted(one.repeated for one in reports) == [False, True]


def test_a_corrected_contract_with_the_same_id_is_the_newest(cell, monkeypatch):
    with open_robot(StubClient(cell), cell, monkeypatch) as robot:
        states = [
            robot.run(robot.contract([{"skill": "hold", "params": {"duration": duration}}], contract_id)).state
            for duration, contract_id in ((500.0, "c-0001"), (1.0, "c-0002"), (1.0, "c-0001"))
        ]
        assert states == ["rejected", "finished", "finished"]
        assert [one["id"] for one in robot.recent()] == ["c-0001", "c-0002"]


class WaitingPlanner:
    """Declines every instruction when `may_answer` is set; counts the requests that it answers at the same time."""

    name = "waiting"

    def __init__(self):
        self.may_answer, self.begun, self.requests, self.at_once = Event(), Event(), 0, 0
        self._open = 0

    def propose(self, request):
        self.requests, self._open = self.requests + 1, self._open + 1
        self.at_once = max(self.at_once, self._open)
        self.begun.set()
        self.may_answer.wait(5.0)
        self._open -= 1
        return Proposal(text="", finish_reason=STOP, planner=self.name, timings={"total": 0.0})

    def close(self):
        pass


def test_a_planner_that_still_answers_a_stopped_request_gets_the_next_one_afterwards(cell, monkeypatch):
    planner = WaitingPlanner()
    with open_robot(StubClient(cell), cell, monkeypatch, planner=planner) as robot, ThreadPoolExecutor(1) as pool:
        for _ in range(3):
            instruction = pool.submit(robot.do, "go home")
            assert planner.begun.wait(5.0)
            time.sleep(0.1)
            robot.stop()
            assert instruction.result(5.0).outcome.kind == "aborted"
        contract = robot.contract([{"skill": "hold", "params": {"duration": 1.0}}])
        assert robot.run(contract).state == "finished", "a contract waits for no planner"
        assert (planner.requests, planner.at_once) == (1, 1)
        planner.may_answer.set()
        assert robot.do("go home", timeout=5.0).outcome.kind == "rejected"
        assert (planner.requests, planner.at_once) == (3, 1), "the last instruction has two shots"
