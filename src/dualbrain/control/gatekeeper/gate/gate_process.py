"""The gate in a child process: the control process only passes packets on, so that no contract delays a tick.

The child has ordinary priority and checks one contract at a time. If it dies or needs more than `CHECK_TIMEOUT`, it is
killed and started again, and the contract is rejected. It ends when the control process ends.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress

import msgspec

from dualbrain.contracts.verdict import Verdict
from dualbrain.control.gatekeeper.gate import exchange
from dualbrain.control.gatekeeper.gate.contract_checker import ContractChecker
from dualbrain.control.gatekeeper.gate.exchange import GateReply, GateRequest, GateSetup, gate_failure
from dualbrain.control.gatekeeper.robot_link.packet_socket import socket_pair
from dualbrain.errors import DECODE_ERRORS, ConfigurationError

CHECK_TIMEOUT = 2.0
"""Longest time of one check [s]; a check takes milliseconds."""
STARTUP_TIMEOUT = 60.0
"""Longest time [s] until the process is ready."""
MAX_PACKET_BYTES = 1 << 20
"""Longest packet [bytes]: a contract of 64 KiB with its scene."""
_PROGRAM = """\
import os, sys
try:
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
except (OSError, AttributeError):
    pass
from dualbrain.control.gatekeeper.gate.gate_process import serve
serve(int(sys.argv[1]))
os._exit(0)
"""
"""Program of the child, which gives up an inherited real-time priority before it imports anything."""


class GateProcess:
    """Passes one request at a time to the child process; implements `ContractGate`. No method waits, except `close`."""

    def __init__(self, setup: GateSetup, monotonic: Callable[[], float] = time.monotonic) -> None:
        """Start the child; `wait_until_ready` waits for it. Time limits are measured by `monotonic` [s]."""
        self._setup, self._monotonic = setup, monotonic
        self._request: GateRequest | None = None
        self._failure: Verdict | None = None
        self._number = 0
        self._start()

    @property
    def busy(self) -> bool:
        """Whether a contract is being checked, or its reply has not been taken."""
        return self._request is not None

    def wait_until_ready(self) -> None:
        """Wait until the child can check contracts; raises `ConfigurationError` if it does not start."""
        deadline = time.monotonic() + STARTUP_TIMEOUT
        while not self._ready and time.monotonic() < deadline and self.process.poll() is None:
            self._receive()
            time.sleep(0.005)
        if not self._ready:
            code = self.process.poll()
            happened = f"is not ready after {STARTUP_TIMEOUT:.0f} s" if code is None else f"exited with code {code}"
            self.close()
            raise ConfigurationError.stating(f"The gate process {happened}.", fix="See its messages on standard error.")

    def submit(self, request: GateRequest) -> bool:
        """Take a request; returns False while another one is being checked."""
        if self.busy:
            return False
        self._request, self._number = request, self._number + 1
        self._submitted_at = self._monotonic()
        try:
            packet = exchange.encode_check(self._number, request)
            if not self._send(packet):
                self._restart()  # the child died since the last contract
                self._socket.send(packet)
        except (OSError, ValueError, OverflowError) as error:
            self._fail(f"the gate process cannot be reached: {error}")
        return True

    def take_reply(self) -> GateReply | None:
        """The reply, or None while none is ready; a child that died or exceeded its time is a rejection."""
        request = self._request
        if request is None:
            return None
        packet = self._receive() if self._failure is None else None
        if packet is None and self._failure is None and self._monotonic() > self._deadline():
            self._fail(f"the check took longer than {CHECK_TIMEOUT:.0f} s")
        verdict = packet.verdict if packet is not None else self._failure
        if verdict is None:
            return None
        seconds = packet.seconds if packet is not None else self._monotonic() - self._submitted_at
        self._request = self._failure = None
        return GateReply(request, verdict, seconds)

    def close(self) -> None:
        """End the child."""
        self._socket.close()
        self.process.kill()
        self.process.wait()

    def _start(self) -> None:
        ours, theirs = socket_pair()
        ours.setblocking(False)
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, *(["-S"] if sys.flags.no_site else []), "-c", _PROGRAM, str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(theirs.fileno(),),
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
                start_new_session=True,
            )
        self._socket, self._ready, self._started_at = ours, False, self._monotonic()
        with suppress(OSError):
            ours.send(exchange.encode(self._setup))

    def _deadline(self) -> float:
        """Time at which the check of the current request has taken too long [s]."""
        if not self._ready:
            return self._started_at + STARTUP_TIMEOUT
        return max(self._submitted_at, self._ready_at) + CHECK_TIMEOUT

    def _receive(self) -> exchange.VerdictPacket | None:
        """The verdict on the current request, if it has arrived; notes when the child is ready."""
        try:
            data = self._socket.recv(MAX_PACKET_BYTES)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            self._fail("the gate process ended")
            return None
        try:
            packet = exchange.decode_from_gate(data)
        except DECODE_ERRORS as error:
            self._fail(f"the gate process sent a malformed packet: {error}")
            return None
        if isinstance(packet, exchange.Ready):
            self._ready, self._ready_at = True, self._monotonic()
            return None
        return packet if packet.number == self._number else None

    def _send(self, packet: bytes) -> bool:
        """Send a packet to the child; returns whether the child lives."""
        try:
            self._socket.send(packet)
        except (BrokenPipeError, ConnectionError):
            return False
        return True

    def _fail(self, problem: str) -> None:
        """Reject the current request and replace the child."""
        if self._request is not None:
            self._failure = gate_failure(problem)
            self._restart()

    def _restart(self) -> None:
        self.close()
        self._start()


def serve(handle: int) -> None:
    """Check the contracts that arrive at the inherited socket `handle`, until the other end is closed."""
    link = socket.socket(fileno=handle)
    link.setblocking(True)
    checker = ContractChecker(msgspec.msgpack.decode(link.recv(MAX_PACKET_BYTES), type=GateSetup))
    link.send(exchange.encode(exchange.Ready()))
    while data := link.recv(MAX_PACKET_BYTES):
        packet = exchange.decode_check(data)
        signal.setitimer(signal.ITIMER_REAL, 2.0 * CHECK_TIMEOUT)  # ends this process even without a parent
        start = time.monotonic()
        verdict = checker.check(exchange.request_of(packet))
        seconds = time.monotonic() - start
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        link.send(_encode_verdict(packet.number, verdict, seconds))


def _encode_verdict(number: int, verdict: Verdict, seconds: float) -> bytes:
    """The packet of a verdict; a verdict that no packet can hold becomes a rejection."""
    try:
        data = exchange.encode(exchange.VerdictPacket(number=number, verdict=verdict, seconds=seconds))
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        data = b""
        verdict = gate_failure(f"{type(error).__name__}: {error}")
    if 0 < len(data) <= MAX_PACKET_BYTES // 4:
        return data
    if data:
        verdict = gate_failure("the verdict is too long")
    return exchange.encode(exchange.VerdictPacket(number=number, verdict=verdict, seconds=seconds))
