"""What the runtime writes around a contract: number, times, principal and scene version; never written by the model."""

from __future__ import annotations

import msgspec


class Stamp(msgspec.Struct, frozen=True):
    """One shot of one principal: `sequence` rises with every shot; valid in [issued, expires) [s, the gate's clock].

    A contract is good for one acceptance, in its time, for the scene it was made for (`scene_version`).
    """

    sequence: int
    issued: float
    expires: float
    principal: str
    scene_version: int
