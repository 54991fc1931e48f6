"""The control loop: executes accepted contracts through skills, filter and supervisor; no language model in it.

Public is the client of the gatekeeper, the process in which the control loop of a real arm runs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dualbrain.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dualbrain.control.gatekeeper.protocol.authentication import Keys, load_keys
    from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient

_MODULES = {
    "control.gatekeeper.protocol.authentication": (
        "Keys",
        "load_keys",
    ),
    "control.gatekeeper.protocol.client": (
        "ConnectionLostError",
        "GatekeeperClient",
    ),
}
"""Public names by the module that defines them."""

__all__ = [
    "ConnectionLostError",
    "GatekeeperClient",
    "Keys",
    "load_keys",
]

__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
