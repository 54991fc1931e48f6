"""A reply of the gatekeeper is that to the request for which the client waits, also after a reply that came late."""

import socket
import time
from contextlib import suppress
from threading import Thread

import pytest

from dualbrain.contracts.verdict import Rejected
from dualbrain.control.gatekeeper.protocol import client as client_module
from dualbrain.control.gatekeeper.protocol.authentication import load_keys
from dualbrain.control.gatekeeper.protocol.client import (
    ConnectionLostError,
    ContractNotCheckedError,
    GatekeeperClient,
)
from dualbrain.control.gatekeeper.protocol.frames import FrameDecoder, encode
from dualbrain.control.gatekeeper.protocol.messages import (
    Challenge,
    CheckReport,
    CheckRequest,
    Hello,
    OutcomeReport,
    Propose,
    RequestRefused,
    SceneReport,
    SceneRequest,
    VerdictReport,
    Welcome,
    decode_message,
    encode_body,
    kind_code,
)
from dualbrain.records import Outcome, Scene

TIMEOUT = 0.3
"""Longest wait of the client for a verdict in these tests [s]."""
SCENE = Scene(robot="panda", stamp=0.0, version=1, objects=())
REJECTED = Rejected(stage="envelope", pointer="", got="x", allowed="y", hint="z")


class ScriptedGatekeeper:
    """Answers the n-th contract with the n-th entry of `script`, and scene requests with the time.

    An entry is a function of the sequence number that returns the replies; a held reply follows with `release`.
    """

    def __init__(self, path, script):
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen(1)
        self._sent, self._script, self._held = 0, list(script), []
        self.proposed, self.holds_scenes = [], False
        self._thread = Thread(target=self._serve, daemon=True)
        self._thread.start()

    def send(self, message):
        self._sent += 1
        self._connection.sendall(encode(kind_code(message), self._sent, encode_body(message)))

    def release(self):
        """Send the replies that were held."""
        held, self._held = self._held, []
        for message in held:
            self.send(message)

    def close(self):
        self._connection.close()
        self._listener.close()

    def _serve(self):
        self._connection, _ = self._listener.accept()
        self.send(Challenge(b"n" * 16))
        decoder = FrameDecoder()
        with suppress(BrokenPipeError):  # the client has closed the connection before an answer
            while data := self._receive():
                decoder.feed(data)
                while (frame := decoder.next_frame()) is not None:
                    self._answer(frame.sequence, decode_message(frame, from_client=True))

    def _receive(self):
        try:
            return self._connection.recv(65536)
        except OSError:
            return b""

    def _answer(self, sequence, message):
        match message:
            case Hello():
                self.send(Welcome(role="commander", now=time.monotonic(), robot="panda", registry=""))
            case SceneRequest():
                report = SceneReport(now=time.monotonic(), scene=SCENE, q=(), opening=None, holding=None)
                if self.holds_scenes:
                    self._held.append(report)
                else:
                    self.release()  # one connection keeps the order of its replies
                    self.send(report)
            case Propose(contract=contract):
                self.proposed.append(contract)
                replies, held = self._script.pop(0)(sequence)
                self._held += held
                for reply in replies:
                    self.send(reply)
            case CheckRequest():
                self.send(CheckReport(sequence=sequence, refused="another contract is being checked"))
            case _:
                pass


def outcome(reason):
    return lambda sequence: OutcomeReport(Outcome(kind="succeeded", reason=reason), {})


def accepted(sequence):
    return VerdictReport(sequence=sequence, rejected=None, gate_s=0.0)


def rejected(sequence):
    return VerdictReport(sequence=sequence, rejected=REJECTED, gate_s=0.0)


def busy(sequence):
    return RequestRefused("busy: one contract at a time")


def at_once(*replies):
    """The answer to a contract that sends `replies`."""
    return lambda sequence: ([reply(sequence) for reply in replies], [])


def late(*replies):
    """The answer to a contract that holds `replies`."""
    return lambda sequence: ([], [reply(sequence) for reply in replies])


@pytest.fixture
def connect(tmp_path, monkeypatch):
    monkeypatch.setattr(client_module, "REPLY_TIMEOUT", TIMEOUT)
    opened = []

    def open_both(*script):
        gatekeeper = ScriptedGatekeeper(tmp_path / "s", script)
        client = GatekeeperClient(tmp_path / "s", load_keys(tmp_path / "keys", ("planner",)), "planner")
        opened.extend((client, gatekeeper))
        return gatekeeper, client

    yield open_both
    for one in opened:
        one.close()


def lose_first_verdict(client):
    with pytest.raises(ConnectionLostError, match="stop the robot"):
        client.propose(b"first", 1)


def test_a_contract_that_is_not_checked_leaves_the_connection_as_it_is(connect):
    _, client = connect(at_once(accepted))
    with pytest.raises(ContractNotCheckedError, match="not checked: another contract is being checked"):
        client.check(b"first")
    assert not client.disconnected.is_set()
    assert client.propose(b"second", 1).rejected is None


def test_a_late_verdict_is_not_that_of_the_next_contract(connect):
    gatekeeper, client = connect(late(accepted, outcome("of the first")), at_once(rejected))
    lose_first_verdict(client)
    gatekeeper.release()
    assert client.propose(b"second", 1).rejected == REJECTED
    assert client.poll_outcome(TIMEOUT) is None


def test_a_late_rejection_is_not_that_of_the_next_contract_which_runs(connect):
    gatekeeper, client = connect(late(rejected), at_once(accepted, outcome("of the second")))
    lose_first_verdict(client)
    gatekeeper.release()
    assert client.propose(b"second", 1).rejected is None
    assert client.wait_for_outcome(TIMEOUT).outcome.reason == "of the second"


def test_a_late_verdict_that_arrives_while_the_next_one_is_awaited_is_dropped(connect):
    first = []

    def hold_first(sequence):
        first.append(sequence)
        return [], []

    def answer_both(sequence):
        replies = at_once(lambda _: accepted(first[0]), outcome("of the first"), accepted, outcome("of the second"))
        return replies(sequence)

    _, client = connect(hold_first, answer_both)
    lose_first_verdict(client)
    assert client.propose(b"second", 1).rejected is None
    assert client.wait_for_outcome(TIMEOUT).outcome.reason == "of the second"


def test_a_late_refusal_which_names_no_contract_is_not_that_of_the_next_one(connect):
    _, client = connect(late(busy), at_once(accepted))
    lose_first_verdict(client)
    assert isinstance(client.propose(b"second", 1), VerdictReport)  # the refusal comes with the next scene


def test_no_contract_follows_a_lost_verdict_while_the_gatekeeper_does_not_answer(connect):
    gatekeeper, client = connect(late())
    lose_first_verdict(client)
    gatekeeper.holds_scenes = True
    with pytest.raises(ConnectionLostError, match="SceneReport"):
        client.propose(b"second", 1)
    assert gatekeeper.proposed == [b"first"]


def test_an_outcome_that_was_not_read_is_not_that_of_the_next_contract(connect):
    _, client = connect(at_once(accepted, outcome("of the first")), at_once(accepted))
    assert client.propose(b"first", 1).rejected is None
    time.sleep(0.1)
    assert client.propose(b"second", 1).rejected is None
    assert client.poll_outcome(TIMEOUT) is None


def test_a_scene_after_a_late_one_is_new(connect):
    gatekeeper, client = connect()
    gatekeeper.holds_scenes = True
    with pytest.raises(ConnectionLostError, match="SceneReport"):
        client.request_scene(TIMEOUT)
    gatekeeper.holds_scenes = False
    for _ in range(3):
        asked = time.monotonic()
        assert client.request_scene(TIMEOUT).now >= asked
