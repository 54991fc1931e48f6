"""Addresses, TLS files and tokens of the HTTP server."""

import stat
from pathlib import Path

import pytest

from dualbrain.agent_server.http_server import HttpConfig
from dualbrain.agent_server.token import TOKEN_VARIABLE, load_token
from dualbrain.errors import ConfigurationError

PEM = Path("file.pem")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.8.8", "::1", "localhost"])
def test_a_server_on_this_machine_needs_no_tls(host):
    assert HttpConfig(port=1, token="t" * 20, host=host).url.startswith("http://")


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.2", "robot.example.org", ""])
def test_a_server_for_others_needs_tls(host):
    with pytest.raises(ConfigurationError, match="--tls-cert"):
        HttpConfig(port=1, token="t" * 20, host=host)
    assert HttpConfig(port=1, token="t" * 20, host=host, certificate=PEM, private_key=PEM).url.startswith("https://")


def test_half_a_pair_of_tls_files_is_refused():
    with pytest.raises(ConfigurationError, match="both"):
        HttpConfig(port=1, token="t" * 20, certificate=PEM)


def test_a_token_is_made_once_and_private(tmp_path):
    path = tmp_path / "folder" / "token"
    token = load_token(path, {})
    assert token == load_token(path, {})
    assert len(token) >= 32
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_the_environment_has_precedence(tmp_path):
    assert load_token(tmp_path / "token", {TOKEN_VARIABLE: "e" * 20}) == "e" * 20
    assert not (tmp_path / "token").exists()


@pytest.mark.parametrize("token", ["short", "with a space in it", "line\nend-0123456789", "é" * 20, "x" * 600])
def test_a_weak_or_unprintable_token_is_refused(token, tmp_path):
    with pytest.raises(ConfigurationError):
        load_token(tmp_path / "token", {TOKEN_VARIABLE: token})
    (tmp_path / "token").write_text(token)
    with pytest.raises(ConfigurationError):
        load_token(tmp_path / "token", {})
