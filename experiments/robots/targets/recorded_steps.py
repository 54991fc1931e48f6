"""Steps of the host's filter as the messages that a target gets, and their comparison with its replies."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.result import FilterResult
from dualbrain.safety.target.frames import decode_frame
from dualbrain.safety.target.messages import CYCLE_REPLY, CycleReply, Message, TargetDescription, parse_cycle_reply
from dualbrain.safety.target.session import TargetLostError, TargetSession
from dualbrain.safety.target.target_filter import TargetFilter
from dualbrain.safety.target.target_kernel import TargetKernel
from experiments.robots.targets.random_motion import RandomMotion

MOST_OUTSTANDING = 24
"""Cycles that the target has got and not answered; both rings of the mailbox have room for them."""
REPLY_TIMEOUT_S = 20.0
PAUSE_S = 0.004
"""Sleep before replies are read [s]; the link would poll for the next one and take a core from the emulator."""
EMPTY_REPLY = parse_cycle_reply(bytes(CYCLE_REPLY.size))
HOST = TargetDescription(nonce=0, robot_hash=0, kernel_hash=0, joints=0, max_obstacles=48, board="host")


@dataclass
class RecordedSteps:
    """Messages in their order, the host's result of each cycle, and the results by status.

    It has the methods of a `TargetSession` that a `TargetKernel` uses, and records the messages.
    """

    messages: list[tuple[Message, bytes]] = field(default_factory=list)
    results: list[FilterResult] = field(default_factory=list)
    statuses: Counter[str] = field(default_factory=Counter)
    description: TargetDescription = HOST

    def send(self, kind: Message, payload: bytes) -> int:
        """Record a message."""
        self.messages.append((kind, payload))
        return len(self.messages)

    def cycle(self, payload: bytes) -> CycleReply:
        """Record a CYCLE."""
        self.send(Message.CYCLE, payload)
        return EMPTY_REPLY


def record_steps(robot: str, seed: list[int], steps: int) -> RecordedSteps:
    """Random motion of a robot on the host."""
    model, recorded = load_robot(robot), RecordedSteps()
    safety = TargetFilter(model, operating_config(model), recorded)  # pyright: ignore[reportArgumentType]

    def keep(result: FilterResult, reply: CycleReply) -> bool:
        del reply
        recorded.results.append(result)
        return True

    safety.target._agrees = keep
    recorded.statuses = RandomMotion(model, np.random.default_rng(seed)).run(safety, steps)
    return recorded


def compare_steps(recorded: RecordedSteps, session: TargetSession, kernel: TargetKernel) -> int:
    """Send the messages to a target; `kernel` counts its replies, and those with other bits than the host's.

    Returns the number of replies with a control; at a standstill it is zero, and only the rest of a result is compared.

    Raises:
        TargetLostError: the target does not answer.
    """
    results, waiting, controls = iter(recorded.results), deque[int](), 0
    for kind, payload in recorded.messages:
        sequence = session.send(kind, payload)
        if kind == Message.CYCLE:
            waiting.append(sequence)
        if len(waiting) >= MOST_OUTSTANDING:
            controls += _compare_replies(results, session, kernel, waiting)
    while waiting:
        controls += _compare_replies(results, session, kernel, waiting)
    return controls


def _compare_replies(
    results: Iterator[FilterResult], session: TargetSession, kernel: TargetKernel, waiting: deque[int]
) -> int:
    """Compare the replies that have arrived; returns the number of those with a control."""
    time.sleep(PAUSE_S)
    data, controls = session.link.read(REPLY_TIMEOUT_S), 0
    if not data:
        raise TargetLostError(f"no reply within {REPLY_TIMEOUT_S:g} s")
    for piece in session._reader.feed(data):
        frame = decode_frame(piece, session._key)
        if frame is None or (frame.type, frame.sequence) != (Message.CYCLE_REPLY, waiting.popleft()):
            raise TargetLostError("a reply is torn or not the next one")
        reply = parse_cycle_reply(frame.payload)
        kernel._agrees(next(results), reply)
        controls += not (reply.at_standstill or not reply.drive_enabled)
    return controls
