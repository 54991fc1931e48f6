"""Addresses, TLS files and tokens of the HTTP server."""

import socket
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

from dualbrain.agent_server.http_server import HttpConfig
from dualbrain.agent_server.token import TOKEN_VARIABLE, load_token
from dualbrain.errors import ConfigurationError

PEM = Path("file.pem")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.8.8", "::1", "localhost"])
def test_a_server_on_this_machine_needs_no_tls(host):
    assert HttpConfig(port=1, token="t" * 20, host=host).url.startswith("http://")


@pytest.mark.parametrize("host", ["192.168.1.2", "2001:db8::1", "robot.example.org"])
def test_a_server_for_others_needs_tls(host):
    with pytest.raises(ConfigurationError, match="--tls-cert"):
        HttpConfig(port=1, token="t" * 20, host=host)
    assert HttpConfig(port=1, token="t" * 20, host=host, certificate=PEM, private_key=PEM).url.startswith("https://")


@pytest.mark.parametrize("host", ["0.0.0.0", "::", ""])
@pytest.mark.parametrize("files", [None, PEM])
def test_a_wildcard_address_is_refused_because_no_request_names_it(host, files):
    with pytest.raises(ConfigurationError, match="answer no request"):
        HttpConfig(port=1, token="t" * 20, host=host, certificate=files, private_key=files)


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


@pytest.mark.parametrize("port", [0, -1, 65536, 99999])
def test_a_port_that_does_not_exist_is_refused(port):
    with pytest.raises(ConfigurationError, match="1 to 65535"):
        HttpConfig(port=port, token="t" * 20).open_listener()


def test_an_address_in_use_is_refused_before_anything_else_starts():
    with socket.create_server(("127.0.0.1", 0)) as other, pytest.raises(ConfigurationError, match="in use"):
        HttpConfig(port=other.getsockname()[1], token="t" * 20).open_listener()


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """A certificate and its private key."""
    folder, key = tmp_path_factory.mktemp("tls"), ec.generate_private_key(ec.SECP256R1())
    name, now = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "test")]), datetime.now(UTC)
    builder = x509.CertificateBuilder().subject_name(name).issuer_name(name).public_key(key.public_key())
    builder = builder.serial_number(1).not_valid_before(now).not_valid_after(now + timedelta(days=1))
    certificate = builder.sign(key, hashes.SHA256())
    form = (Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    (folder / "cert.pem").write_bytes(certificate.public_bytes(Encoding.PEM))
    (folder / "key.pem").write_bytes(key.private_bytes(*form))
    return folder / "cert.pem", folder / "key.pem"


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return probe.getsockname()[1]


def test_tls_files_that_belong_together_are_accepted(pair):
    with HttpConfig(
        port=free_port(), token="t" * 20, certificate=pair[0], private_key=pair[1]
    ).open_listener() as found:
        assert found.getsockname()[0] == "127.0.0.1"


@pytest.mark.parametrize("case", ["missing", "exchanged", "no certificate"])
def test_tls_files_that_cannot_be_used_are_named(case, pair, tmp_path):
    (tmp_path / "text").write_text("no certificate")
    files = {"missing": (PEM, PEM), "exchanged": pair[::-1], "no certificate": (tmp_path / "text", pair[1])}[case]
    expected = "There is no TLS file" if case == "missing" else "cannot be used"
    with pytest.raises(ConfigurationError, match=expected) as raised:
        HttpConfig(port=free_port(), token="t" * 20, certificate=files[0], private_key=files[1]).open_listener()
    assert str(files[0]) in str(raised.value)
