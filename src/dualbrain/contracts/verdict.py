"""The gate's answer: an accepted contract or the stage, place and reason of its refusal (paper 3.3)."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from dualbrain.contracts.contract import Contract

Stage = Literal["syntax", "authorization", "envelope"]


class Accepted(msgspec.Struct, frozen=True, tag_field="verdict", tag="accepted"):
    """The contract passed all three stages."""

    contract: Contract


class Rejected(msgspec.Struct, frozen=True, tag_field="verdict", tag="rejected", kw_only=True):
    """The contract was refused at `stage`.

    `pointer` (RFC 6901) is the place in the contract, "" the whole of it or the stamp around it; `got` is safe to print
    and bounded; `allowed` says what may stand there; `hint` says how to mend it.
    """

    stage: Stage
    pointer: str
    got: Any
    allowed: Any
    hint: str


Verdict = Accepted | Rejected
