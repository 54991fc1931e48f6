"""A contract with filter and supervisor on an emulated board; its recording is recomputed on the host."""

import re

import pytest

from dualbrain.control.recording.replay import replay
from dualbrain.errors import ConfigurationError
from dualbrain.safety.target import emulated_board
from tests.stories.story_session import contract_text, run_config, run_session

HOLD = contract_text(("hold", {"duration": 0.5}))


def test_a_contract_runs_on_a_board_and_its_recording_is_recomputed_bit_for_bit(tmp_path):
    config = run_config(tmp_path, target="an386")
    found = run_session(config, HOLD)
    assert found.episode.outcome.kind == "succeeded"
    (text,) = [event.text for event in found.result.trace.events if event.kind == "target"]
    assert re.fullmatch(r"an386: [1-9]\d+ steps on target and host, 0 with different bits", text)
    assert replay(config.out / "episode.mcap").identical


def test_without_an_emulator_the_run_names_the_package(tmp_path, monkeypatch):
    monkeypatch.setattr(emulated_board.shutil, "which", lambda name: None)
    with pytest.raises(ConfigurationError, match="apt-get install qemu-system-arm"):
        run_session(run_config(tmp_path, target="an386"), HOLD)
