"""The gatekeeper's confirmation of a stop: a status report from after the stop."""

from __future__ import annotations

import time
from typing import Protocol

from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError
from dualbrain.control.gatekeeper.protocol.messages import SceneReport, StatusReport

CONFIRMATION_TIMEOUT = 1.0
"""Longest wait for the report of a stop [s]."""
LOOK_PERIOD = 0.01
"""Time between two looks at the newest status [s]."""
DRIVE_OFF = ("ESTOP", "LOCKOUT")
"""Actions that show an emergency stop."""
STANDSTILL = ("HOLD", "CONTROLLED_STOP", *DRIVE_OFF)
"""Actions that show a stop while a contract is not yet at its end."""


class StatusSource(Protocol):
    """The part of `GatekeeperClient` that a confirmation needs."""

    @property
    def status(self) -> StatusReport | None:
        """The newest status; None before the first one."""
        ...

    def request_scene(self, timeout: float) -> SceneReport:
        """The present scene; see `GatekeeperClient.request_scene`."""
        ...


def confirm_stop(client: StatusSource) -> StatusReport:
    """The first status from after the stop that `client` has sent which shows a stop, or that no contract runs.

    The gatekeeper takes commands and requests in order, so a status that is newer than the scene requested here is from
    after the stop. Raises `ConnectionLostError` without such a status within `CONFIRMATION_TIMEOUT`.
    """
    deadline = time.monotonic() + CONFIRMATION_TIMEOUT
    try:
        since = client.request_scene(CONFIRMATION_TIMEOUT).now
    except ConnectionLostError as error:
        raise _unconfirmed(f" ({error})") from error
    while time.monotonic() < deadline:
        status = client.status
        if status is not None and status.now > since and (not status.busy or status.action in STANDSTILL):
            return status
        time.sleep(LOOK_PERIOD)
    raise _unconfirmed("")


def find_emergency_status(client: StatusSource) -> StatusReport | None:
    """A status of `client` that shows an emergency stop, which another connection has confirmed already.

    None if there is none within `CONFIRMATION_TIMEOUT`, for example because the connection of `client` is lost.
    """
    deadline = time.monotonic() + CONFIRMATION_TIMEOUT
    while time.monotonic() < deadline:
        if (status := client.status) is not None and status.action in DRIVE_OFF:
            return status
        time.sleep(LOOK_PERIOD)
    return None


def _unconfirmed(detail: str) -> ConnectionLostError:
    return ConnectionLostError(
        f"the stop was sent, but the gatekeeper did not confirm it within {CONFIRMATION_TIMEOUT:g} s{detail}; use the "
        "emergency stop"
    )
