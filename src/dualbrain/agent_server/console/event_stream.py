"""Live events and status of a robot as server-sent events."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Any

import anyio
from starlette.responses import StreamingResponse

from dualbrain.agent_server.console.console_robot import ConsoleRobot
from dualbrain.agent_server.console.responses import COMMON_HEADERS, encode_visible
from dualbrain.control.gatekeeper.protocol.messages import StatusReport

PERIOD = 0.1
"""Time between two looks at the events [s]."""
STATUS_PERIOD = 1.0
"""Time after which an unchanged status is sent again [s], so that the page notices a lost connection."""
STALE_AFTER = 1.0
"""Age of a status from which the robot counts as not reporting [s]; a gatekeeper reports every 60 ms."""


class StatusAge:
    """The age of the newest status: its time stamp does not change while the robot does not report."""

    def __init__(self) -> None:
        """Nothing was reported yet."""
        self._stamp, self._since = -1.0, time.monotonic()

    def view(self, status: StatusReport | None) -> dict[str, Any]:
        """The status for the page: state, reason, whether a contract runs, and whether the robot reports."""
        if status is None:
            return {"state": "unknown", "reason": "no status yet", "busy": False, "reporting": False}
        if status.now != self._stamp:
            self._stamp, self._since = status.now, time.monotonic()
        reporting = time.monotonic() - self._since < STALE_AFTER
        return {"state": status.action, "reason": status.check, "busy": status.busy, "reporting": reporting}


@dataclass(frozen=True, slots=True)
class StreamStart:
    """What a client has already: the events up to the number `after`, from the server with the id `server`.

    `server` is None for a client that does not state it, and "" for one that has seen no server yet.
    """

    after: int
    server: str | None

    def first_number(self, server: str, newest: int) -> int:
        """The number after which the events of `server` begin for this client; `newest` is the newest number.

        The numbers of an earlier server do not count, and this one may have no event yet.
        """
        is_other = self.after > newest if self.server is None else self.server != server
        return 0 if is_other else self.after


def event_response(
    robot: ConsoleRobot, start: StreamStart, server: str, has_ended: Callable[[], bool]
) -> StreamingResponse:
    """The events from `start` on and every change of the status, until the client or the server ends it.

    `server` is the id of this server, which a client that states one gets first: event numbers begin again with it.
    """
    headers = {**COMMON_HEADERS, "X-Accel-Buffering": "no"}
    messages = _messages(robot, start, server, has_ended)
    return StreamingResponse(messages, media_type="text/event-stream", headers=headers)


async def _messages(
    robot: ConsoleRobot, start: StreamStart, server: str, has_ended: Callable[[], bool]
) -> AsyncIterator[bytes]:
    kept = robot.events()
    after = start.first_number(server, kept[-1]["number"] if kept else 0)
    if start.server is not None:
        yield _message("server", {"id": server})
    age, shown, shown_at = StatusAge(), None, 0.0
    while not has_ended():
        for event in robot.events(after):
            after = event["number"]
            yield _message("event", event)
        status, now = age.view(robot.status()), time.monotonic()
        if status != shown or now - shown_at >= STATUS_PERIOD:
            shown, shown_at = status, now
            yield _message("status", status)
        await anyio.sleep(PERIOD)


def _message(kind: str, data: dict[str, Any]) -> bytes:
    return f"event: {kind}\ndata: ".encode() + encode_visible(data) + b"\n\n"
