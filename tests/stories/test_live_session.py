"""A run in real time behind a gatekeeper process: the same episode, ledger and replay as in lockstep."""

import json

import pytest

from dualbrain.cli.main import run_command_line
from dualbrain.control.recording.replay import replay
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.runtime.backends.gatekeeper import ADDRESS_FILE, GatekeeperBackend
from dualbrain.runtime.session import RunObserver, Session
from tests.stories.story_session import contract_text, hold_contract, ledger_episodes, make_clocks, run_config

pytestmark = [pytest.mark.slow, pytest.mark.realtime]
"""These tests need a machine without other load."""


def test_a_live_run_rejects_replans_moves_and_replays_bit_for_bit(tmp_path):
    config = run_config(tmp_path)
    wrong = contract_text(("hold", {"duration": 99.0}))
    events = []
    planner = ScriptedPlanner((wrong, hold_contract()))
    with Session(config, make_clocks(), {}, planner, GatekeeperBackend()) as session:
        finished = session.run(RunObserver(events.append))
    episode = finished.episode
    assert [type(attempt.verdict).__name__ for attempt in episode.attempts] == ["Rejected", "Accepted"]
    assert episode.attempts[0].verdict.stage == "envelope"
    assert (episode.outcome.kind, episode.outcome.Delta) == ("succeeded", 0.0)
    assert episode.judgement.violations == ()
    assert len(ledger_episodes(config.ledger)) == 1
    assert len(finished.trace) > 500
    assert replay(config.out / "episode.mcap").identical
    timing = json.loads((config.out / "punctuality.json").read_bytes())
    assert timing["interval"][0] < 2e-3
    assert not (config.out / ADDRESS_FILE).exists(), "the gatekeeper has removed its address"
    assert any(event.kind == "action" for event in events)


def test_an_operator_needs_a_gatekeeper_and_the_filter_cannot_be_off(tmp_path, capsys):
    assert (
        run_command_line(["operate", "pause", "--socket", str(tmp_path / "none"), "--keys", str(tmp_path / "keys")])
        == 5
    )
    assert "dualbrain gatekeeper" in capsys.readouterr().err
    assert run_command_line(["run", "x", "--live", "--filter", "off"]) == 2
    assert run_command_line(["run", "x", "--live", "--speed", "200%"]) == 2
