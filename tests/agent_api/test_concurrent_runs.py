"""Contracts one after another and at once: one motion each, and the newest report comes first."""

import time
from concurrent.futures import ThreadPoolExecutor

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
