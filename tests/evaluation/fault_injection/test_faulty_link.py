"""A link to a target whose messages fail: each kind in both directions."""

import pytest

from dualbrain.evaluation.fault_injection.faults import KINDS, Fault, FaultInjector
from dualbrain.evaluation.fault_injection.faulty_link import FaultyLink

MESSAGES = [bytes([number]) * 8 for number in range(40)]


class Line:
    """A link that answers each read with the next message, and keeps the written ones."""

    def __init__(self):
        self.written, self.closed = [], False
        self._answers = iter(MESSAGES)

    def write(self, data):
        self.written.append(data)

    def read(self, timeout):
        return next(self._answers)

    def close(self):
        self.closed = True


def link_with(kind, *, to_target, line):
    """A link that fails in the wanted direction, its fault not yet triggered."""
    for seed in range(30):
        injector = FaultInjector(Fault("target", kind, "closing", seed), lambda: 0.0)
        link = FaultyLink(line, injector)
        if link.fails_to_target == to_target:
            return link, injector
    raise AssertionError("no seed fails in this direction")


def passed_messages(kind, *, to_target, monkeypatch):
    """The messages that arrive while the fault is active; two were passed before it."""
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    line = Line()
    link, injector = link_with(kind, to_target=to_target, line=line)
    arrived = []
    for number, message in enumerate(MESSAGES):
        if number == 2:
            injector.triggered_at = 0.0
        if to_target:
            line.written.clear()
            link.write(message)
            arrived.append(b"".join(line.written))
            assert link.read(0.1)  # the other direction works
        else:
            arrived.append(link.read(0.1))
            link.write(message)
            assert line.written[-1] == message
    link.close()
    assert line.closed
    assert arrived[:2] == MESSAGES[:2]
    return arrived[2:]


@pytest.mark.parametrize("to_target", [True, False])
@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_in_each_direction(kind, to_target, monkeypatch):
    arrived, sent = passed_messages(kind, to_target=to_target, monkeypatch=monkeypatch), MESSAGES[2:]
    match kind:
        case "off":
            assert set(arrived) == {b""}
        case "stuck":
            assert set(arrived) == {MESSAGES[1]}
        case "garbage":
            assert all(len(one) == 8 for one in arrived)
            assert len({*arrived, *sent}) == 2 * len(sent)
        case "wrong":
            flipped = [
                (int.from_bytes(one) ^ int.from_bytes(other)).bit_count()
                for one, other in zip(arrived, sent, strict=True)
            ]
            assert set(flipped) == {1}
        case "slow":
            assert [one for one in arrived if one] == sent[9::10]
        case "delayed":
            assert arrived == MESSAGES[1:-1]
        case _:
            kept = [one == other for one, other in zip(arrived, sent, strict=True)]
            assert 8 < sum(kept) < 30
            assert {one for one, good in zip(arrived, kept, strict=True) if not good} == {b""}
