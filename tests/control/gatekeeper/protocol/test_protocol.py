"""Frames, authentication, capabilities and the socket server: laws that hold for any bytes."""

import os
import socket
import stat
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.gatekeeper.capability import Capability
from dualbrain.control.gatekeeper.protocol import server as server_module
from dualbrain.control.gatekeeper.protocol.authentication import (
    PRINCIPALS,
    SECRET_BYTES,
    contract_mac,
    hello_proof,
    load_keys,
    verify_contract_mac,
    verify_hello_proof,
)
from dualbrain.control.gatekeeper.protocol.frames import (
    HEADER,
    MAGIC,
    MAX_BODY_BYTES,
    VERSION,
    BrokenStream,
    Frame,
    FrameDecoder,
    encode,
)
from dualbrain.control.gatekeeper.protocol.messages import (
    CLIENT_MESSAGES,
    Heartbeat,
    Message,
    OperatorCommand,
    Propose,
    decode_message,
    encode_body,
    kind_code,
)
from dualbrain.control.gatekeeper.protocol.server import (
    FRAMES_PER_TICK,
    KEPT_OBSERVERS,
    MAX_CONNECTIONS,
    MAX_FRAMES_PER_SECOND,
    SocketServer,
)
from dualbrain.errors import ConfigurationError

BODIES = st.lists(st.binary(max_size=200), max_size=6)


def decode_all(decoder):
    out = []
    while (frame := decoder.next_frame()) is not None:
        out.append(frame)
        if isinstance(frame, BrokenStream):
            break
    return out


# --- frames -----------------------------------------------------------------------------------------------------


@given(BODIES, st.randoms())
def test_frames_round_trip_for_any_fragmentation_of_the_stream(bodies, random):
    stream = b"".join(encode(3, k, body) for k, body in enumerate(bodies, start=1))
    decoder, out = FrameDecoder(), []
    while stream:
        cut = random.randint(1, len(stream))
        decoder.feed(stream[:cut])
        stream = stream[cut:]
        out += decode_all(decoder)
    assert out == [Frame(3, k, body) for k, body in enumerate(bodies, start=1)]
    assert decoder.n_buffered == 0


@given(st.binary(max_size=400))
def test_any_bytes_are_frames_or_a_broken_stream_which_keeps_no_data(data):
    decoder = FrameDecoder()
    decoder.feed(data)
    out = decode_all(decoder)
    if out and isinstance(out[-1], BrokenStream):
        decoder.feed(data)
        assert decoder.n_buffered == 0
        assert decoder.next_frame() is out[-1]
    else:
        assert decoder.n_buffered < HEADER.size + MAX_BODY_BYTES


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        (HEADER.pack(b"XX", VERSION, 1, 0, 1), "not a frame"),
        (HEADER.pack(MAGIC, VERSION + 1, 1, 0, 1), "not a frame"),
        (HEADER.pack(MAGIC, VERSION, 1, MAX_BODY_BYTES + 1, 1), "at most"),
        (HEADER.pack(MAGIC, VERSION, 1, 0, 2), "expected 1"),
        (HEADER.pack(MAGIC, VERSION, 1, 0, 0), "expected 1"),
    ],
)
def test_a_broken_stream_names_the_rule(header, reason):
    decoder = FrameDecoder()
    decoder.feed(header)
    assert reason in decoder.next_frame().reason


@settings(max_examples=300)
@given(st.integers(0, 255), st.binary(max_size=300))
def test_any_body_is_a_message_or_a_reason(kind, body):
    message = decode_message(Frame(kind, 1, body), from_client=True)
    assert isinstance(message, CLIENT_MESSAGES) if isinstance(message, Message) else isinstance(message, str)


def test_a_message_is_only_accepted_in_its_direction():
    frame = Frame(kind_code(Heartbeat()), 1, encode_body(Heartbeat()))
    assert isinstance(decode_message(frame, from_client=True), Heartbeat)
    assert isinstance(decode_message(frame, from_client=False), str)


# --- authentication ---------------------------------------------------------------------------------------------

HEADER_FIELDS = {"issued": 1.0, "expires": 2.0, "scene_version": 3}


def verify_with(**changes):
    """Whether the code of one contract is accepted after `changes` of the key, the connection or the message."""
    mac = contract_mac(b"k" * SECRET_BYTES, b"n" * 16, 7, b"{}", **HEADER_FIELDS)
    facts = {"key": b"k" * SECRET_BYTES, "nonce": b"n" * 16, "sequence": 7}
    facts |= {"contract": b"{}", "mac": mac, **HEADER_FIELDS, **changes}
    key, nonce, sequence = (facts.pop(name) for name in ("key", "nonce", "sequence"))
    return verify_contract_mac(key, nonce, sequence, Propose(**facts))


def test_an_authentication_code_is_valid_for_exactly_one_contract():
    assert verify_with()
    changes = {
        "key": b"K" * SECRET_BYTES,
        "nonce": b"m" * 16,
        "sequence": 8,
        "contract": b"[]",
        "issued": 1.1,
        "expires": 2.1,
        "scene_version": 4,
        "mac": b"",
    }
    for name, value in changes.items():
        assert not verify_with(**{name: value}), name


@pytest.mark.parametrize("scene_version", [-1, 2**63, 2**64 - 1])
def test_a_contract_whose_scene_version_cannot_be_authenticated_is_refused(scene_version):
    contract = Propose(contract=b"{}", issued=1.0, expires=2.0, scene_version=scene_version, mac=b"")
    frame = Frame(kind_code(contract), 1, encode_body(contract))
    assert "scene_version" in decode_message(frame, from_client=True)


@pytest.mark.parametrize("change", [{"scene_version": 2**63}, {"scene_version": -(2**63) - 1}, {"sequence": 2**64}])
def test_a_number_that_no_authentication_code_represents_has_no_valid_code(change):
    assert not verify_with(**change)


def test_a_proof_is_valid_for_one_principal_and_one_nonce():
    key, nonce = b"k" * SECRET_BYTES, b"n" * 16
    proof = hello_proof(key, nonce, "planner")
    assert verify_hello_proof(key, nonce, "planner", proof)
    assert not verify_hello_proof(key, nonce, "operator", proof)
    assert not verify_hello_proof(key, b"o" * 16, "planner", proof)
    assert not verify_hello_proof(b"j" * SECRET_BYTES, nonce, "planner", proof)


def test_a_key_file_is_private_and_persistent(tmp_path):
    folder = tmp_path / "deep" / "keys"
    keys = load_keys(folder, PRINCIPALS)
    path = folder / "planner.key"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert load_keys(folder, PRINCIPALS) == keys
    assert len(set(keys.secrets.values())) == 2
    path.chmod(0o640)
    with pytest.raises(ConfigurationError, match="the mode 640"):
        load_keys(folder, PRINCIPALS)
    path.chmod(0o600)
    path.write_text("ab")
    with pytest.raises(ConfigurationError, match="fewer than 32 bytes"):
        load_keys(folder, PRINCIPALS)


# --- capabilities -----------------------------------------------------------------------------------------------

INTERVALS = st.tuples(st.floats(-2, 2), st.floats(-2, 2))
CAPABILITIES = st.builds(
    Capability,
    st.frozensets(st.sampled_from(["grasp", "place", "home"])),
    st.dictionaries(st.sampled_from(["grasp.speed", "grasp.force", "place.speed"]), INTERVALS),
    st.floats(0, 100),
    st.floats(0, 100),
)
NUMBERS = st.floats(-3, 3)


def allows(capability, skill, speed, force):
    contract = Contract("c", Context("panda", ""), (Action(skill, {"speed": speed, "force": force}),))
    return skill in capability.skills and capability.check_bounds(contract) is None


@given(CAPABILITIES, CAPABILITIES, st.sampled_from(["grasp", "place", "home"]), NUMBERS, NUMBERS)
def test_delegation_allows_exactly_what_both_sides_allow(one, other, skill, speed, force):
    both = one.intersect(other)
    assert allows(both, skill, speed, force) == (
        allows(one, skill, speed, force) and allows(other, skill, speed, force)
    )
    assert both.rate == min(one.rate, other.rate)
    assert both.expires == min(one.expires, other.expires)


@given(CAPABILITIES, CAPABILITIES, CAPABILITIES)
def test_delegation_is_a_meet(a, b, c):
    assert a.intersect(b) == b.intersect(a)
    assert a.intersect(a) == a
    assert a.intersect(b).intersect(c) == a.intersect(b.intersect(c))


# --- socket server ----------------------------------------------------------------------------------------------


HEARTBEAT = encode_body(Heartbeat())
CLIENTS = []


@pytest.fixture
def server(tmp_path):
    one = SocketServer(tmp_path / "s")
    yield one
    one.close()
    close_clients()


def close_clients():
    while CLIENTS:
        CLIENTS.pop().close()


def connect(server):
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    CLIENTS.append(client)
    client.connect(str(server.path))
    client.setblocking(False)
    list(server.receive(0.0))
    return client


def test_only_the_owner_can_open_the_socket(server):
    assert stat.S_IMODE(server.path.stat().st_mode) == 0o600


def test_a_socket_in_use_is_refused_and_a_stale_one_is_replaced(server, tmp_path):
    with pytest.raises(ConfigurationError, match="in use by a running gatekeeper"):
        SocketServer(server.path)
    stale = tmp_path / "stale"
    closed = socket.socket(socket.AF_UNIX)
    closed.bind(str(stale))
    closed.close()
    SocketServer(stale).close()


def test_other_users_are_refused(server, monkeypatch):
    monkeypatch.setattr(server_module, "_peer_uid", lambda accepted: os.getuid() + 1)
    connect(server)
    assert server.connections == []


def test_a_tick_reads_no_more_than_its_budget_and_a_flood_is_disconnected(server):
    client = connect(server)
    client.recv(4096)
    sent, now, n_received, most = 0, 0.0, 0, 0
    for _ in range(3000):
        with suppress(BlockingIOError):
            while True:
                client.send(encode(kind_code(Heartbeat()), sent + 1, HEARTBEAT))
                sent += 1
        got = len(list(server.receive(now)))
        n_received, most, now = n_received + got, max(most, got), now + 1e-3
        if failed := server.failed_connections():
            assert [connection.fault for connection in failed] == ["flood"]
            break
    assert most == FRAMES_PER_TICK
    assert n_received == MAX_FRAMES_PER_SECOND
    assert server.connections == []


def test_a_flood_of_one_client_does_not_delay_another(server):
    loud, quiet = connect(server), connect(server)
    loud.send(b"".join(encode(kind_code(Heartbeat()), k, HEARTBEAT) for k in range(1, 300)))
    quiet.send(encode(kind_code(Heartbeat()), 1, HEARTBEAT))
    assert server.connections[1] in {connection for connection, _, _ in server.receive(0.0)}


def test_a_client_that_does_not_read_is_disconnected(server):
    client = connect(server)
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
    for _ in range(100_000):
        server.connections[0].send(Heartbeat())
        if server.connections[0].fault:
            break
    assert [one.fault for one in server.failed_connections()] == ["the client does not read its messages"]


def test_there_is_always_room_for_another_observer(server):
    clients = [connect(server) for _ in range(3 * MAX_CONNECTIONS)]
    assert len(server.connections) == MAX_CONNECTIONS
    assert server.connections[-1].number == len(clients)


def wait_in_the_queue(server, count=1):
    """Clients that have connected and are not accepted yet."""
    clients = [socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) for _ in range(count)]
    CLIENTS.extend(clients)
    for client in clients:
        client.connect(str(server.path))
    return clients


def send_stop(client):
    stop = OperatorCommand(act="estop")
    client.send(encode(kind_code(stop), 1, encode_body(stop)))


def occupy(server, n_observers):
    """As many connections without a key as are possible, the oldest of which are observers."""
    for _ in range(MAX_CONNECTIONS):
        connect(server)
    for connection in server.connections[:n_observers]:
        connection.role = "observer"


def messages(server, now=0.0):
    return [message for _, _, message in server.receive(now)]


@pytest.mark.parametrize("n_observers", [0, 3, 8, MAX_CONNECTIONS])
@pytest.mark.parametrize("accepted", [False, True], ids=["waiting", "accepted"])
def test_no_client_replaces_a_connection_whose_stop_was_not_read(server, accepted, n_observers):
    """Neither a stop that is sent while the client waits, nor one that is sent after it was accepted."""
    occupy(server, n_observers)
    (stopper,) = wait_in_the_queue(server)
    received = messages(server) if accepted else []
    send_stop(stopper)
    received += [] if accepted else messages(server)
    wait_in_the_queue(server, MAX_CONNECTIONS)
    received += messages(server, 0.001)
    assert received == [OperatorCommand(act="estop")]


def test_a_client_that_is_accepted_is_read_in_the_same_tick(server):
    occupy(server, 0)
    for client in wait_in_the_queue(server, server_module.ACCEPTED_PER_TICK):
        send_stop(client)
    assert len(messages(server)) == server_module.ACCEPTED_PER_TICK


def test_observers_beyond_the_kept_ones_are_replaced_first_and_then_strangers(server):
    occupy(server, 8)
    first = server.connections[0]
    expected = [1, 2, *range(9, 13), *range(13, 19)]
    for number in expected:
        assert number in [connection.number for connection in server.connections]
        connect(server)
        assert number not in [connection.number for connection in server.connections]
    assert first not in server.connections
    assert sum(connection.role == "observer" for connection in server.connections) == KEPT_OBSERVERS


def test_a_connection_with_a_fault_is_not_replaced_before_it_is_reported(server):
    occupy(server, 0)
    for connection in server.connections:
        connection.fault = "malformed"
    wait_in_the_queue(server)
    assert messages(server) == []
    assert len(server.failed_connections()) == MAX_CONNECTIONS
    assert messages(server) == []
    assert len(server.connections) == 1


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(min_size=1, max_size=600), min_size=1, max_size=8))
def test_after_any_bytes_the_server_accepts_the_next_client(tmp_path_factory, chunks):
    server = SocketServer(tmp_path_factory.mktemp("server") / "s")
    client = connect(server)
    for chunk in chunks:
        with suppress(OSError):
            client.send(chunk)
        list(server.receive(0.0))
    server.failed_connections()
    assert connect(server).recv(2) == MAGIC
    server.close()
    close_clients()
