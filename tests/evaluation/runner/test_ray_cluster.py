"""Evaluation on a Ray cluster: refused without a token or on unequal nodes; lines are those of one process."""

import json
import os
import pickle
import secrets
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

pytest.importorskip("ray", reason="Ray is not installed: pip install 'dualbrain[ray]'")

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.main import run_command_line
from dualbrain.errors import ConfigurationError
from dualbrain.evaluation.runner.provenance import code_hash, collect_provenance
from dualbrain.evaluation.runner.ray_cluster.connection import NodeFacts, read_facts, require_equal_node, require_token
from dualbrain.evaluation.runner.ray_cluster.pool import ActorWorker
from tests.evaluation.runner.ray_cluster_process import RESULTS, TIME_FIELDS
from tests.evaluation.runner.test_worker_pool import make_doubler

ROOT = Path(__file__).resolve().parents[3]
TOKEN = {"RAY_AUTH_MODE": "token"}


@pytest.fixture
def private_token(tmp_path):
    """A home folder with a private token."""
    path = tmp_path / ".ray" / "auth_token"
    path.parent.mkdir()
    path.write_text("0" * 64)
    path.chmod(0o600)
    return path


def test_a_private_token_in_any_place_is_enough(tmp_path, private_token):
    require_token(TOKEN, tmp_path)
    require_token(TOKEN | {"RAY_AUTH_TOKEN": "0" * 64}, tmp_path / "elsewhere")
    require_token(TOKEN | {"RAY_AUTH_TOKEN_PATH": str(private_token)}, tmp_path / "elsewhere")


@pytest.mark.parametrize("environ", [{}, {"RAY_AUTH_MODE": "disabled"}, {"RAY_AUTH_MODE": "", "RAY_AUTH_TOKEN": "0"}])
def test_a_cluster_without_token_authentication_is_refused(tmp_path, private_token, environ):
    with pytest.raises(ConfigurationError, match=r"needs token authentication: .*Export RAY_AUTH_MODE=token"):
        require_token(environ, tmp_path)


def test_a_missing_token_and_one_that_others_can_read_are_refused(tmp_path, private_token):
    private_token.chmod(0o640)
    with pytest.raises(ConfigurationError, match=f"chmod 600 {private_token}"):
        require_token(TOKEN, tmp_path)
    private_token.unlink()
    with pytest.raises(ConfigurationError, match=r"There is no token .* No such file or directory"):
        require_token(TOKEN, tmp_path)


def test_the_command_refuses_before_it_writes_anything(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    out = tmp_path / "out"
    code = run_command_line(["evaluate", "--suite", "smoke", "--pool", "ray", "--out", str(out)])
    assert (code, "RAY_AUTH_MODE is ''" in capsys.readouterr().err, out.exists()) == (ExitCode.SETUP, True, False)


def test_a_node_must_have_a_token_the_same_code_and_the_results_folder(tmp_path, monkeypatch):
    file, here = tmp_path / "config.json", collect_provenance()
    file.touch()
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    facts = read_facts(str(file))
    require_equal_node("n", facts, here, file)
    older = NodeFacts(authentication="token", provenance=here | {"code": "0", "numpy": "1"}, sees_results=True)
    for changed, words in (
        (msgspec.structs.replace(facts, authentication=""), "was started without token authentication"),
        (older, f"has code 0 instead of {here['code']}, numpy 1 instead of"),
        (msgspec.structs.replace(facts, sees_results=False), "does not see the results folder"),
    ):
        with pytest.raises(ConfigurationError, match=words):
            require_equal_node("n", changed, here, file)
    assert not read_facts(str(tmp_path / "absent")).sees_results


def test_a_worker_with_other_code_does_not_start():
    with pytest.raises(RuntimeError, match=f"another code of dualbrain: {code_hash()} instead of 0000"):
        ActorWorker(pickle.dumps(make_doubler), {}, "0000")


@pytest.fixture(scope="module")
def on_cluster(tmp_path_factory):
    """Results of a process that starts a cluster of two nodes and works on it."""
    folder = tmp_path_factory.mktemp("ray")
    (folder / "token").write_text(secrets.token_hex(32))
    (folder / "token").chmod(0o600)
    variables = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(folder / "token"), "PYTHONPATH": str(ROOT)}
    environ = {**os.environ, **variables, "DUALBRAIN_HOME": str(folder / "home")}
    command = [sys.executable, "-m", "tests.evaluation.runner.ray_cluster_process", str(folder)]
    subprocess.run(command, cwd=ROOT, env=environ, check=True, timeout=600.0)
    return json.loads((folder / RESULTS).read_text())


@pytest.mark.slow
def test_a_failed_or_dead_unit_costs_only_itself(on_cluster):
    found = on_cluster["units"]
    assert found["zero"]["error"] == "ZeroDivisionError: division by zero"
    assert "the worker died: " in found["dead"]["error"]
    assert [found[str(n)]["lines"] for n in range(1, 6)] == [2] * 5
    assert not any(found[str(n)]["error"] for n in range(1, 6))
    assert on_cluster["lost"] == 1


@pytest.mark.slow
def test_units_of_a_lost_node_are_reported_and_the_others_finish(on_cluster):
    found = on_cluster["lost node"]
    assert 1 <= sum(bool(one["error"]) for one in found.values()) <= 2
    assert all(one["lines"] == 2 for one in found.values() if not one["error"])


@pytest.mark.slow
def test_rows_are_those_of_one_process(on_cluster):
    serial, cluster = on_cluster["serial rows"], on_cluster["cluster rows"]
    assert serial.keys() == cluster.keys()
    for key, row in serial.items():
        assert {k for k, value in row.items() if cluster[key][k] != value} <= set(TIME_FIELDS)
