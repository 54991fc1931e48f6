"""Invalid bytes from outside are rejected in all three ways in which decoding can fail (msgspec's own error is one)."""

import re
import socket
from pathlib import Path

import msgspec
import pytest

import dualbrain
from dualbrain.adaptation.adapters.card import CARD_FILE, WEIGHTS_FILE, read_adapter_card
from dualbrain.control.gatekeeper.protocol.authentication import PRINCIPALS, load_keys
from dualbrain.control.gatekeeper.robot_link.packet_socket import MalformedPacket, PacketSocket
from dualbrain.errors import DECODE_ERRORS, ConfigurationError

DEEP = b'{"also":' * 100_000 + b"1" + b"}" * 100_000
BAD = {"not UTF-8": b'{"id":"\xff"}', "not JSON": b"\xff\xfe", "too deep": DEEP, "wrong type": b"[]"}


def test_no_module_catches_only_one_of_them():
    package = Path(dualbrain.__file__).parent
    catches = re.compile(r"(except|suppress\()[^\n]*msgspec\.(DecodeError|MsgspecError)")
    found = [path.name for path in package.rglob("*.py") if catches.search(path.read_text(encoding="utf-8"))]
    assert found == []


@pytest.mark.parametrize("data", BAD.values(), ids=BAD)
def test_an_invalid_file_is_a_configuration_error(tmp_path, data):
    (tmp_path / WEIGHTS_FILE).write_bytes(b"")
    (tmp_path / CARD_FILE).write_bytes(data)
    with pytest.raises(ConfigurationError):
        read_adapter_card(tmp_path)
    keys = tmp_path / "keys"
    keys.write_bytes(data)
    keys.chmod(0o600)
    with pytest.raises(ConfigurationError):
        load_keys(keys, PRINCIPALS)


@pytest.mark.parametrize("error", DECODE_ERRORS)
def test_an_invalid_packet_is_malformed(error):
    def decode(data):
        raise error("utf-8", data, 0, 1, "bad") if error is UnicodeDecodeError else error("bad")

    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        link = PacketSocket(ours, decode)
        theirs.send(b"x")
        assert isinstance(link.receive(), MalformedPacket)
        assert link.is_open
    assert issubclass(msgspec.ValidationError, DECODE_ERRORS)
