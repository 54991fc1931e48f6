"""`dualbrain gatekeeper --record` on a full disk: refused in a sentence, unless the operator chose otherwise."""

import signal
import subprocess
import sys

import pytest

from dualbrain.cli import main
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.control.gatekeeper import process
from tests.support.small_disk import fill, mounted_disk


@pytest.fixture
def full_disk(tmp_path, monkeypatch):
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path / "home"))
    with mounted_disk(tmp_path / "disk", 4) as folder:
        fill(folder)
        yield folder


def test_a_gatekeeper_does_not_start_without_space_for_its_recording(full_disk):
    command = [sys.executable, *(["-S"] if sys.flags.no_site else []), "-m", "dualbrain", "gatekeeper"]
    arguments = ["--scene", "bare:0", "--record", str(full_disk / "ticks.mcap")]
    done = subprocess.run([*command, *arguments], capture_output=True, text=True, timeout=60.0, check=False)
    assert done.returncode == ExitCode.SETUP
    assert "8 MB for the end of the recording cannot be reserved" in done.stderr
    assert "No space left on device. Free some space." in done.stderr
    assert "Traceback" not in done.stderr


def test_the_option_reaches_the_gatekeeper(tmp_path, monkeypatch):
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path / "home"))
    seen = []

    def stop(config, on_ready, on_warning):
        seen.append(config)
        raise KeyboardInterrupt

    monkeypatch.setattr(process, "run_gatekeeper", stop)
    monkeypatch.setattr(signal, "signal", lambda number, handler: None)
    for options in ([], ["--unrecorded"]):
        main.run_command_line(["gatekeeper", "--scene", "bare:0", *options])
    assert [(config.unrecorded, bool(config.registrations)) for config in seen] == [(False, True), (True, True)]
