"""Verdict of the gate: an accepted contract, or the stage, place and reason of the rejection (paper 3.3)."""

from __future__ import annotations

from typing import Any, Literal, get_args

import msgspec

from dualbrain.contracts.contract import Contract

Stage = Literal["syntax", "authorization", "envelope"]
STAGES: tuple[Stage, ...] = get_args(Stage)
"""The stages of the gate, in their order."""


class Accepted(msgspec.Struct, frozen=True, tag_field="verdict", tag="accepted"):
    """The contract passed all three stages."""

    contract: Contract


class Rejected(msgspec.Struct, frozen=True, tag_field="verdict", tag="rejected", kw_only=True):
    """The contract was rejected at `stage`.

    `pointer` (RFC 6901) is the place in the contract, "" for the whole contract or its header; `got` is the value found
    there, bounded and safe to print; `allowed` are the allowed values; `hint` is the correction.
    """

    stage: Stage
    pointer: str
    got: Any
    allowed: Any
    hint: str


Verdict = Accepted | Rejected
