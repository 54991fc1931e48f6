"""`dualbrain.run`: an agent, a planner or a contract plans; its default configuration is that of the commands."""

from dataclasses import replace

import pytest

import dualbrain
from dualbrain.memory import HashingEncoder, Ledger, MemoryConfig, PostureLimits
from dualbrain.runtime.backends import simulated
from dualbrain.runtime.config import default_config
from tests.stories.story_session import hold_contract

INSTRUCTION = "rest a little"


class FixedPlanner:
    """A planner that answers every request with the same contract and records the requests."""

    name = "fixed"

    def __init__(self):
        self.requests, self.closed = [], False

    def propose(self, request):
        self.requests.append(request)
        return dualbrain.Proposal(
            text=hold_contract(), finish_reason="stop", planner=self.name, constrained_by="", timings={"total": 0.0}
        )

    def close(self):
        self.closed = True


@pytest.fixture(autouse=True)
def short_planning_time(monkeypatch):
    monkeypatch.setattr(simulated, "PLANNING_TIME", 0.02)


def open_memory(path):
    """A memory with its own ledger in the file `path`."""
    limits = PostureLimits.from_model(dualbrain.load_robot("panda"))
    ledger = Ledger(path, holder="test", now=1.0)
    return dualbrain.Memory(ledger, HashingEncoder(), MemoryConfig(limits=(limits,)))


def test_an_agent_plans_and_remembers_instead_of_the_configured_planner_and_memory(tmp_path):
    planner, memory = FixedPlanner(), open_memory(tmp_path / "own.sqlite")
    asked = []
    agent = dualbrain.Agent(planner, memory, lambda instruction, summary: asked.append((instruction, summary)) or ())
    events = []
    results = [
        dualbrain.run(
            INSTRUCTION,
            scene="bare:0",
            agent=agent,
            out=tmp_path / name,
            observer=dualbrain.RunObserver(on_event=events.append),
        )
        for name in ("one", "two")
    ]
    assert [result.episode.attempts[0].proposal.planner for result in results] == ["fixed", "fixed"]
    assert all(isinstance(result, dualbrain.RunResult) for result in results)
    assert list(memory.weights()) == [result.store_report.episode_id for result in results]
    assert [instruction for instruction, _ in asked] == [INSTRUCTION] * 2
    assert len(planner.requests) == 2
    assert events
    assert not planner.closed
    memory.ledger.close()


def test_the_own_ledger_of_a_run_with_an_agent_holds_no_episode(tmp_path):
    memory = open_memory(tmp_path / "own.sqlite")
    out = tmp_path / "run"
    dualbrain.run(INSTRUCTION, scene="bare:0", agent=dualbrain.Agent(FixedPlanner(), memory), out=out)
    with Ledger(out / "ledger.sqlite", holder="test", now=1.0) as ledger:
        assert not list(ledger.events("episode"))
    memory.ledger.close()


def test_with_a_contract_no_planner_is_asked(tmp_path):
    path, planner = tmp_path / "c.json", FixedPlanner()
    path.write_text(hold_contract(), "utf-8")
    result = dualbrain.run(INSTRUCTION, scene="bare:0", planner=planner, contract=path, out=tmp_path / "run")
    assert result.episode.attempts[0].proposal.planner == "file c.json"
    assert not planner.requests


def test_an_agent_and_a_contract_exclude_each_other(tmp_path):
    agent = dualbrain.Agent(FixedPlanner(), open_memory(tmp_path / "own.sqlite"))
    with pytest.raises(dualbrain.ConfigurationError, match="Both an agent and a contract"):
        dualbrain.run(INSTRUCTION, agent=agent, contract=tmp_path / "c.json", out=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    agent.memory.ledger.close()


def test_the_default_configuration_uses_the_folders_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path))
    config = default_config(INSTRUCTION)
    assert (config.ledger, config.knowledge, config.adapters) == (
        tmp_path / "ledger.sqlite",
        tmp_path / "knowledge.sqlite",
        tmp_path / "adapters",
    )
    assert config.out.parent.name == "runs"
    named = default_config(INSTRUCTION, out=tmp_path / "a", ledger=tmp_path / "b")
    assert named == replace(config, out=tmp_path / "a", ledger=tmp_path / "b")
