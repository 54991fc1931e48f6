"""Layout of a policy's action: the entries of the arm, and their units."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError

Array = NDArray[np.float64]


class Layout(Protocol):
    """How an action contains the values of the arm."""

    def check(self, count: int) -> None:
        """Raise `ConfigurationError` if the layout does not fit `count` values."""
        ...

    def read(self, action: Any, count: int, size: int | None) -> Array | str:
        """The `count` values in SI units, or why `action` is unusable; `size` is its number of entries if known."""
        ...

    def write(self, values: Array, action: Any) -> Any:
        """A copy of `action` with `values`, in SI units, for the arm."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionLayout:
    """Where an action vector has the values of the arm, and how they become SI units: value = scale · entry + offset.

    `entries` are the indices of the arm's values in the action; None: the first ones. `scale` and `offset` are one
    number or one per value. All other entries (gripper, base, termination) pass the guard unchanged.
    """

    entries: tuple[int, ...] | None = None
    scale: float | Sequence[float] = 1.0
    offset: float | Sequence[float] = 0.0

    def check(self, count: int) -> None:
        """Raise `ConfigurationError` if `entries`, `scale` or `offset` does not fit `count` values."""
        found = list(range(count)) if self.entries is None else list(self.entries)
        if len(found) != count or len(set(found)) != count or min(found) < 0:
            raise ConfigurationError("ActionLayout.entries", got=found, allowed=f"{count} different indices from 0")
        for name, values in (("scale", self.scale), ("offset", self.offset)):
            given = np.asarray(values, float)
            usable = given.shape in ((), (count,)) and np.isfinite(given).all()
            if not usable or (name == "scale" and not given.all()):
                allowed = f"one finite number or {count}, for a scale not 0"
                raise ConfigurationError(f"ActionLayout.{name}", got=given.tolist(), allowed=allowed)

    def read(self, action: Any, count: int, size: int | None) -> Array | str:
        """The values of the arm in SI units, or the reason why `action` has none."""
        numbers = as_numbers(action, size)
        if isinstance(numbers, str):
            return numbers
        indices = self._indices(count)
        if max(indices) >= len(numbers):
            return f"the action has {len(numbers)} entries, and the arm needs entry {max(indices)}"
        return np.asarray(self.scale) * numbers[indices] + np.asarray(self.offset)

    def write(self, values: Array, action: Any) -> NDArray[Any]:
        """A copy of `action` with `values`, which are in SI units, at the entries of the arm."""
        replaced = copy_as_floats(action)
        replaced[self._indices(len(values))] = (values - np.asarray(self.offset)) / np.asarray(self.scale)
        return replaced

    def _indices(self, count: int) -> list[int]:
        return list(range(count)) if self.entries is None else list(self.entries)


@dataclass(frozen=True, slots=True)
class FunctionLayout:
    """A layout by two functions: `decode(action)` gives the values in SI units, `encode(values, action)` an action."""

    decode: Callable[[Any], Any]
    encode: Callable[[Array, Any], Any]

    def check(self, count: int) -> None:
        """Nothing is known about the functions."""

    def read(self, action: Any, count: int, size: int | None) -> Array | str:
        """The values that `decode` gives, or the reason why they are unusable."""
        del size
        return as_numbers(self.decode(action), count)

    def write(self, values: Array, action: Any) -> Any:
        """The action that `encode` gives."""
        return self.encode(values, action)


def check_option(name: str, value: str, allowed: Collection[str]) -> None:
    """Raise `ConfigurationError` unless `value` is one of the `allowed` words."""
    if value not in tuple(allowed):
        raise ConfigurationError(name, got=value, allowed=" or ".join(allowed))


def copy_as_floats(action: Any) -> NDArray[Any]:
    """A copy of `action` that can hold any number: an array of integers would cut the digits off."""
    copied = np.array(action)
    return copied if np.issubdtype(copied.dtype, np.floating) else copied.astype(np.float64)


def as_numbers(action: Any, size: int | None) -> Array | str:
    """`action` as a vector of numbers, or the reason why it is none; `size` is the number of entries if it is known."""
    try:
        given = np.asarray(action)
        values = np.asarray(given, dtype=np.float64) if not np.iscomplexobj(given) else None
    except (TypeError, ValueError, OverflowError, RuntimeError):  # RuntimeError: a tensor that requires a gradient
        values = None
    if values is None:
        return f"the action is no vector of numbers but {type(action).__name__}"
    if values.ndim != 1 or (size is not None and len(values) != size):
        expected = "a vector" if size is None else f"a vector of {size} numbers"
        return f"the action has the shape {values.shape}, expected is {expected}"
    if not np.isfinite(values).all():
        return f"entry {int(np.flatnonzero(~np.isfinite(values))[0])} of the action is not finite"
    return values
