"""Every reader of a user's file refuses special, huge and hostile files at once, in one sentence."""

import io
import os
import time

import msgspec
import pytest

from dualbrain.adaptation.adapters.card import CARD_FILE, WEIGHTS_FILE, read_adapter_card
from dualbrain.adaptation.config import read_config
from dualbrain.cli.run.check import check
from dualbrain.core.untrusted.bounded_process import ProcessLimits
from dualbrain.drivers.commissioning.checklist import read_checklist
from dualbrain.errors import ConfigurationError, DualbrainError, UnknownNameError
from dualbrain.evaluation.protocol.suite import load_suite, parse_suite
from dualbrain.evaluation.results.parquet import read_results, write_results
from dualbrain.grounding.document_retrieval import check_templates
from dualbrain.knowledge.library import Submission
from dualbrain.robots.loader import load_robot, read_robot
from dualbrain.robots.site_config import SiteError, read_site
from dualbrain.runtime.inspection import memory_replay
from dualbrain.simulation.scenes.scene_spec import load_scene
from tests.evaluation.sample_rows import SUITE, episode_row

TOML_READERS = {
    "site": (read_site, "a.toml"),
    "checklist": (read_checklist, "a.toml"),
    "suite": (lambda path: load_suite(str(path)), "a.toml"),
    "adaptation": (read_config, "a.toml"),
}
READERS = {
    **TOML_READERS,
    "contract": (check, "a.json"),
    "scene": (load_scene, "a.json"),
    "robot": (read_robot, "a.json"),
    "results": (read_results, "results.parquet"),
}
HOSTILE_TOML = {
    "deep arrays": "x = " + "[" * 100_000,
    "closed deep arrays": "x = " + "[" * 3_000 + "]" * 3_000,
    "deep tables": "x = " + "{a=" * 3_000 + "1" + "}" * 3_000,
    "long key": "a" + ".a" * 100_000 + " = 1",
    "digits": "x = " + "9" * 4_301,
    "digits in a table": "[robot]\nperiod = " + "9" * 50_000,
    "not UTF-8": b"x = '\xff'",
    "open string": 'x = """' * 10_000,
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("kind", ["fifo", "device", "huge"])
def test_a_special_or_huge_file_is_refused_at_once(tmp_path, reader, kind):
    read, name = READERS[reader]
    path = tmp_path / name
    match kind:
        case "fifo":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case _:
            with path.open("wb") as file:
                file.truncate(1 << 40)
    start = time.monotonic()
    with pytest.raises(ConfigurationError, match=r"regular file|larger than"):
        read(path)
    assert time.monotonic() - start < 10.0


@pytest.mark.parametrize("reader", TOML_READERS)
@pytest.mark.parametrize("kind", HOSTILE_TOML)
def test_hostile_toml_is_a_configuration_error(tmp_path, reader, kind):
    text = HOSTILE_TOML[kind]
    (tmp_path / "a.toml").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ConfigurationError) as refused:
        TOML_READERS[reader][0](tmp_path / "a.toml")
    assert "\n" not in str(refused.value)


def test_a_fault_of_a_site_file_has_line_and_column(tmp_path):
    (tmp_path / "a.toml").write_text("[robot]\nperiod = " + "9" * 5_000)
    with pytest.raises(SiteError) as refused:
        read_site(tmp_path / "a.toml")
    assert (refused.value.line, refused.value.column) == (2, 10)


def test_standard_input_is_read_up_to_a_limit(monkeypatch):
    with open("/dev/zero", "rb") as endless:
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(endless))
        with pytest.raises(ConfigurationError, match="standard input is larger than"):
            check("-")


def damaged(data, kind):
    match kind:
        case "cut":
            return data[: len(data) // 2] + b"PAR1"
        case "empty":
            return b"PAR1" * 3
        case "lying footer":
            return data[:-8] + b"\xff\xff\xff\x7f" + b"PAR1"
        case "zeros":
            return b"PAR1" + bytes(len(data)) + data[-8:]
        case _:
            return data[:200] + bytes(byte ^ 0x5A for byte in data[200:-300]) + data[-300:]


@pytest.mark.parametrize("kind", ["cut", "empty", "lying footer", "zeros", "changed"])
def test_torn_results_are_a_configuration_error(tmp_path, kind):
    path = tmp_path / "results.parquet"
    write_results([episode_row(repetition=k) for k in range(5)], {"suite": {}}, path)
    assert len(read_results(path)[0]) == 5
    path.write_bytes(damaged(path.read_bytes(), kind))
    with pytest.raises(ConfigurationError, match=r"results\.parquet") as refused:
        read_results(path)
    assert "\n" not in str(refused.value)


def test_every_torn_byte_of_results_is_an_error_or_the_rows(tmp_path):
    path = tmp_path / "results.parquet"
    write_results([episode_row()], {"suite": {}}, path)
    whole = path.read_bytes()
    for at in range(8, len(whole) - 8, max(1, len(whole) // 12)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        try:
            read_results(path)
        except DualbrainError as error:
            assert "\n" not in str(error)  # noqa: PT017


def test_results_that_exceed_the_limits_are_refused(tmp_path):
    path = tmp_path / "results.parquet"
    write_results([episode_row(repetition=k) for k in range(50)], {"suite": {}}, path)
    with pytest.raises(ConfigurationError, match="contains more than 1 kB"):
        read_results(path, ProcessLimits(output_bytes=1024))


@pytest.mark.parametrize("name", ["../../../etc/passwd", "./robot.json", "robot.json", "/dev/zero"])
def test_the_name_of_a_robot_in_a_file_opens_no_file(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.json").write_bytes(msgspec.json.encode(load_robot("panda")))
    with pytest.raises(UnknownNameError, match="packaged robot"):
        parse_suite(f'robots = ["{name}"]\n'.encode() + SUITE, "a.toml")
    with pytest.raises(UnknownNameError, match="packaged robot"):
        memory_replay._run_once(None, None, name, None)
    template = f"""kind = "template"
title = "t"
robots = ["{name}"]
[[templates]]
name = "fetch"
use_when = "lift the cup"
slots = {{}}
action_sequence = [ {{ skill = "home", params = {{ speed = 0.1 }} }} ]
"""
    assert check_templates(Submission(file="t.toml", data=template.encode(), trust="site")) is None


def test_a_card_that_is_a_device_is_refused(tmp_path):
    (tmp_path / WEIGHTS_FILE).write_bytes(b"")
    (tmp_path / CARD_FILE).symlink_to("/dev/zero")
    with pytest.raises(ConfigurationError, match="device"):
        read_adapter_card(tmp_path)
