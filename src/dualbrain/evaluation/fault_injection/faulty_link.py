"""A link to a target whose messages fail, in one direction."""

from __future__ import annotations

import time

import numpy as np

from dualbrain.evaluation.fault_injection.faults import SLOW_UPDATE_TICKS, TARGET, FaultInjector
from dualbrain.safety.target.link import Link

MAX_WAIT_S = 0.05
"""Longest wait within one read that returns nothing [s]."""


class FaultyLink:
    """The link between host and target; `fails_to_target` names the direction that fails, drawn by the seed.

    Messages are lost (off, intermittent: half of them; slow: nine of ten), replaced by the one before (stuck: always
    the last good one; delayed: one message late) or by random bytes (garbage), or one bit is flipped (wrong).
    """

    def __init__(self, link: Link, injector: FaultInjector) -> None:
        """Wrap `link`; it works until the fault is triggered."""
        self._link, self._injector = link, injector
        self._rng = np.random.default_rng([injector.fault.seed, 11])
        self.fails_to_target = bool(self._rng.random() < 0.5)
        self._last, self._count = b"", 0

    def write(self, data: bytes) -> None:
        """Send a message."""
        if sent := self._pass_on(data) if self.fails_to_target else data:
            self._link.write(sent)

    def read(self, timeout: float) -> bytes:
        """The bytes received until now; waits up to `timeout` [s] for the first one."""
        received = self._link.read(timeout)
        if self.fails_to_target or not received:
            return received
        if not (passed := self._pass_on(received)):
            time.sleep(min(timeout, MAX_WAIT_S))
        return passed

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    def _pass_on(self, data: bytes) -> bytes:
        """The message that takes the place of `data`, empty if it is lost."""
        kind, last = self._injector.fault.kind, self._last
        active = self._injector.is_active(TARGET)
        if not active or kind == "delayed":
            self._last = data
        if not active:
            return data
        self._count += 1
        replacements = {
            "stuck": last,
            "delayed": last,
            "garbage": self._rng.bytes(len(data)),
            "wrong": self._with_flipped_bit(data),
            "slow": data if self._count % SLOW_UPDATE_TICKS == 0 else b"",
        }
        return replacements.get(kind, b"")

    def _with_flipped_bit(self, data: bytes) -> bytes:
        changed = bytearray(data)
        changed[self._rng.integers(len(changed))] ^= 1 << int(self._rng.integers(8))
        return bytes(changed)
