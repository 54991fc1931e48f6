"""Frames, seals, capabilities and the door: laws that hold for any bytes."""

import os
import socket
import stat
from contextlib import suppress

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.gatekeeper.capability import Capability
from dualbrain.control.gatekeeper.protocol import server as door_module
from dualbrain.control.gatekeeper.protocol.authentication import (
    SECRET_BYTES,
    contract_mac,
    hello_proof,
    load_or_create_keys,
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
    Propose,
    decode_message,
    encode_body,
    kind_code,
)
from dualbrain.control.gatekeeper.protocol.server import (
    FRAMES_PER_TICK,
    MAX_CONNECTIONS,
    MAX_FRAMES_PER_SECOND,
    SocketServer,
)
from dualbrain.errors import ConfigurationError

BODIES = st.lists(st.binary(max_size=200), max_size=6)


def taken(decoder):
    out = []
    while (frame := decoder.next_frame()) is not None:
        out.append(frame)
        if isinstance(frame, BrokenStream):
            break
    return out


# --- frames -----------------------------------------------------------------------------------------------------


@given(BODIES, st.randoms())
def test_frames_come_out_as_they_went_in_however_they_are_cut(bodies, chance):
    stream = b"".join(encode(3, k, body) for k, body in enumerate(bodies, start=1))
    decoder, out = FrameDecoder(), []
    while stream:
        cut = chance.randint(1, len(stream))
        decoder.feed(stream[:cut])
        stream = stream[cut:]
        out += taken(decoder)
    assert out == [Frame(3, k, body) for k, body in enumerate(bodies, start=1)]
    assert decoder.n_buffered == 0


@given(st.binary(max_size=400))
def test_any_bytes_are_frames_or_broken_and_nothing_is_kept_after(data):
    decoder = FrameDecoder()
    decoder.feed(data)
    out = taken(decoder)
    if out and isinstance(out[-1], BrokenStream):
        decoder.feed(data)
        assert decoder.n_buffered == 0
        assert decoder.next_frame() is out[-1]
    else:
        assert decoder.n_buffered < HEADER.size + MAX_BODY_BYTES


@pytest.mark.parametrize(
    ("header", "why"),
    [
        (HEADER.pack(b"XX", VERSION, 1, 0, 1), "not a frame"),
        (HEADER.pack(MAGIC, VERSION + 1, 1, 0, 1), "not a frame"),
        (HEADER.pack(MAGIC, VERSION, 1, MAX_BODY_BYTES + 1, 1), "at most"),
        (HEADER.pack(MAGIC, VERSION, 1, 0, 2), "expected 1"),
        (HEADER.pack(MAGIC, VERSION, 1, 0, 0), "expected 1"),
    ],
)
def test_what_breaks_a_rule_says_which(header, why):
    decoder = FrameDecoder()
    decoder.feed(header)
    assert why in decoder.next_frame().reason


@settings(max_examples=300)
@given(st.integers(0, 255), st.binary(max_size=300))
def test_any_body_is_a_message_or_a_refusal(kind, body):
    message = decode_message(Frame(kind, 1, body), from_client=True)
    assert isinstance(message, CLIENT_MESSAGES) if isinstance(message, Message) else isinstance(message, str)


def test_nothing_downward_is_heard_upward():
    frame = Frame(kind_code(Heartbeat()), 1, encode_body(Heartbeat()))
    assert isinstance(decode_message(frame, from_client=True), Heartbeat)
    assert isinstance(decode_message(frame, from_client=False), str)


# --- seals ------------------------------------------------------------------------------------------------------

FACTS = {"issued": 1.0, "expires": 2.0, "version": 3}


def sealed(**changes):
    facts = {"key": b"k" * SECRET_BYTES, "nonce": b"n" * 16, "sequence": 7, "contract": b"{}", **FACTS, **changes}
    tag = contract_mac(b"k" * SECRET_BYTES, b"n" * 16, 7, b"{}", **FACTS)
    message = Propose(
        contract=facts["contract"],
        issued=facts["issued"],
        expires=facts["expires"],
        scene_version=facts["version"],
        mac=facts.get("seal", tag),
    )
    return verify_contract_mac(facts["key"], facts["nonce"], facts["sequence"], message)


def test_a_seal_is_good_for_exactly_what_it_was_made_for():
    assert sealed()
    changes = {
        "key": b"K" * SECRET_BYTES,
        "nonce": b"m" * 16,
        "sequence": 8,
        "contract": b"[]",
        "issued": 1.1,
        "expires": 2.1,
        "version": 4,
        "seal": b"",
    }
    for name, value in changes.items():
        assert not sealed(**{name: value}), name


def test_a_proof_is_of_one_principal_and_one_nonce():
    key, nonce = b"k" * SECRET_BYTES, b"n" * 16
    proof = hello_proof(key, nonce, "planner")
    assert verify_hello_proof(key, nonce, "planner", proof)
    assert not verify_hello_proof(key, nonce, "operator", proof)
    assert not verify_hello_proof(key, b"o" * 16, "planner", proof)
    assert not verify_hello_proof(b"j" * SECRET_BYTES, nonce, "planner", proof)


def test_keys_are_private_and_kept(tmp_path):
    path = tmp_path / "deep" / "keys.json"
    keys = load_or_create_keys(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert load_or_create_keys(path) == keys
    assert len(set(keys.secrets.values())) == 2
    path.chmod(0o640)
    with pytest.raises(ConfigurationError, match="0o640"):
        load_or_create_keys(path)
    path.chmod(0o600)
    path.write_text('{"secrets": {"planner": ""}}')
    with pytest.raises(ConfigurationError, match="short"):
        load_or_create_keys(path)


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
    return skill in capability.skills and capability.refusal(contract) is None


@given(CAPABILITIES, CAPABILITIES, st.sampled_from(["grasp", "place", "home"]), NUMBERS, NUMBERS)
def test_delegation_allows_exactly_what_both_sides_allow(one, other, skill, speed, force):
    both = one.narrowed(other)
    assert allows(both, skill, speed, force) == (
        allows(one, skill, speed, force) and allows(other, skill, speed, force)
    )
    assert both.rate == min(one.rate, other.rate)
    assert both.expires == min(one.expires, other.expires)


@given(CAPABILITIES, CAPABILITIES, CAPABILITIES)
def test_delegation_is_a_meet(a, b, c):
    assert a.narrowed(b) == b.narrowed(a)
    assert a.narrowed(a) == a
    assert a.narrowed(b).narrowed(c) == a.narrowed(b.narrowed(c))


# --- the door ---------------------------------------------------------------------------------------------------


GUESTS = []


@pytest.fixture
def door(tmp_path):
    one = SocketServer(tmp_path / "s")
    yield one
    one.close()
    see_out()


def see_out():
    while GUESTS:
        GUESTS.pop().close()


def guest(door):
    link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    GUESTS.append(link)
    link.connect(str(door.path))
    link.setblocking(False)
    list(door.hear(0.0))
    return link


def test_only_the_owner_can_open_the_door(door):
    assert stat.S_IMODE(door.path.stat().st_mode) == 0o600


def test_a_second_door_at_the_same_place_is_refused_and_a_dead_one_is_replaced(door, tmp_path):
    with pytest.raises(ConfigurationError, match="gatekeeper that runs"):
        SocketServer(door.path)
    dead = tmp_path / "dead"
    left = socket.socket(socket.AF_UNIX)
    left.bind(str(dead))
    left.close()
    SocketServer(dead).close()


def test_other_users_are_not_let_in(door, monkeypatch):
    monkeypatch.setattr(door_module, "_peer_uid", lambda link: os.getuid() + 1)
    guest(door)
    assert door.peers == []


def test_a_tick_takes_no_more_than_its_share_and_a_flood_is_shut_out(door):
    link = guest(door)
    link.recv(4096)
    beat = encode_body(Heartbeat())
    sent, now, heard, most = 0, 0.0, 0, 0
    for _ in range(3000):
        with suppress(BlockingIOError):
            while True:
                link.send(b"".join(encode(kind_code(Heartbeat()), sent + k + 1, beat) for k in range(1)))
                sent += 1
        got = len(list(door.hear(now)))
        heard, most, now = heard + got, max(most, got), now + 1e-3
        if wrong := door.failed_connections():
            assert [peer.fault for peer in wrong] == ["flood"]
            break
    assert most == FRAMES_PER_TICK
    assert heard == MAX_FRAMES_PER_SECOND
    assert door.peers == []


def test_a_flood_of_one_does_not_delay_another(door):
    loud, quiet = guest(door), guest(door)
    beat = encode_body(Heartbeat())
    loud.send(b"".join(encode(kind_code(Heartbeat()), k, beat) for k in range(1, 300)))
    quiet.send(encode(kind_code(Heartbeat()), 1, beat))
    assert door.peers[1] in {peer for peer, _, _ in door.hear(0.0)}


def test_whoever_does_not_read_is_let_go(door):
    link = guest(door)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
    for _ in range(100_000):
        door.peers[0].say(Heartbeat())
        if door.peers[0].fault:
            break
    assert [peer.fault for peer in door.failed_connections()] == ["does not read what it is sent"]


def test_there_is_always_room_for_one_more_of_those_who_only_look(door):
    guests = [guest(door) for _ in range(3 * MAX_CONNECTIONS)]
    assert len(door.peers) == MAX_CONNECTIONS
    assert door.peers[-1].number == len(guests)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(min_size=1, max_size=600), min_size=1, max_size=8))
def test_any_bytes_at_the_door_leave_it_open_for_the_next(tmp_path_factory, chunks):
    door = SocketServer(tmp_path_factory.mktemp("door") / "s")
    link = guest(door)
    for chunk in chunks:
        with suppress(OSError):
            link.send(chunk)
        list(door.receive(0.0))
    door.failed_connections()
    assert guest(door).recv(2) == MAGIC
    door.close()
    see_out()
