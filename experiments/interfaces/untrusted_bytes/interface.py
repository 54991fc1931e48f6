"""An interface that takes bytes, and its declared outcome for a bad value: a refusal, or a value that is usable."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import isfinite
from typing import Any

import msgspec
import numpy as np

from dualbrain.core.untrusted.hidden_characters import has_hidden_characters
from experiments.interfaces.untrusted_bytes.mutation import BYTE_KINDS, mutate_bytes, mutate_value

ALWAYS_REFUSED = frozenset({"nan", "infinite", "deep", "compressed", "no bytes"})
"""Kinds that a structured format refuses wherever they stand."""


class Refusal(Exception):  # noqa: N818  (a refusal that the interface returns as a value)
    """An interface refused its input by a value."""


class Surprise(Exception):  # noqa: N818  (an outcome that is not declared)
    """An interface took a bad value in a form that is not usable."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ByteInterface:
    """One way in. `read` returns for usable bytes; it raises an error of dualbrain or `Refusal` for all others.

    `mutate(kind, rng)` gives bytes with one bad value, or None. For a kind of `refuses` an acceptance is a surprise;
    for every other kind `read` itself checks that the accepted value is usable, and raises `Surprise` if it is not.
    `share` is the relative number of cases: less for interfaces that start a process.
    """

    mutate: Callable[[str, np.random.Generator], bytes | None]
    read: Callable[[bytes], None]
    refuses: frozenset[str] = ALWAYS_REFUSED
    share: float = 1.0


def mutator_of_value(value: Any, render: Callable[[bytes], bytes] = bytes) -> Callable[..., bytes | None]:
    """Bad values in `value` as msgpack; `render` makes the bytes of the interface of the encoded value."""

    def mutate(kind: str, rng: np.random.Generator) -> bytes | None:
        if kind in BYTE_KINDS:
            return mutate_bytes(kind, render(msgspec.msgpack.encode(value)), rng)
        changed = value if kind == "valid" else mutate_value(kind, value, rng)
        return None if changed is None else render(msgspec.msgpack.encode(changed))

    return mutate


def refuse_if(refused: object, reason: object = "") -> None:
    """Raise `Refusal` if the product answered with a refusal."""
    if refused:
        raise Refusal(str(reason or refused)[:200])


def require_usable(value: Any, *, visible: bool = False) -> None:
    """Raise `Surprise` unless every number in `value` is finite and, if `visible`, no text has hidden characters."""
    for leaf in _scalars(msgspec.to_builtins(value, enc_hook=_plain)):
        if isinstance(leaf, float) and not isfinite(leaf):
            raise Surprise(f"accepted {leaf}")
        if visible and isinstance(leaf, str) and has_hidden_characters(leaf, allowed="\n\t"):
            raise Surprise(f"accepted the hidden characters in {leaf[:40]!r}")


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else str(value)


def _scalars(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        for key, part in value.items():
            yield key
            yield from _scalars(part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from _scalars(part)
    else:
        yield value
