"""Exceptions for broken set-ups and programming errors.

Expected refusals (a rejected contract, a stopped filter) are values, never exceptions. An exception of this module
states the problem, the value found, the values allowed and the remedy, and carries the same facts as attributes.
"""

from __future__ import annotations

from difflib import get_close_matches
from reprlib import repr as shortened_repr
from typing import Self

import msgspec

DECODE_ERRORS = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
"""Errors of decoding untrusted bytes: msgspec passes on Python's own errors for invalid UTF-8 and for unlimited
nesting. Code that decodes untrusted bytes must catch all three."""


class DualbrainError(Exception):
    """Root of every exception that dualbrain raises on purpose."""


class UnknownNameError(DualbrainError):
    """A name that is not in the closed set it must come from."""

    def __init__(self, kind: str, name: str, known: tuple[str, ...], *, owner: str = "") -> None:
        """Report that `name` is not a `kind` of `owner`, with the closest and all known names."""
        self.kind, self.name, self.known, self.owner = kind, name, tuple(sorted(known)), owner
        close = get_close_matches(name, self.known, n=1)
        hint = f" Closest: {close[0]!r}." if close else ""
        of = f" of {owner}" if owner else ""
        article = "an" if kind[:1] in "aeiou" else "a"
        super().__init__(f"{name!r} is not {article} {kind}{of}.{hint} Known: {', '.join(self.known) or 'none'}.")


class ConfigurationError(DualbrainError):
    """A setting or a file that cannot be used.

    A wrong value is reported as "SETTING: got VALUE, allowed: RANGE."; a wrong state or file as a sentence (`stating`).
    """

    def __init__(self, what: str, *, got: object, allowed: str, fix: str = "", sentence: str = "") -> None:
        """Report the setting `what`, the value `got`, the values `allowed` and the remedy `fix`.

        A `sentence` replaces the first three in the message.
        """
        self.what, self.got, self.allowed, self.fix = what, got, allowed, fix
        problem = sentence or f"{what}: got {got!r}, allowed: {allowed}."
        super().__init__(f"{problem} {fix}" if fix else problem)

    @classmethod
    def stating(cls, sentence: str, *, fix: str = "") -> Self:
        """An error that states a problem in a full `sentence`, followed by the remedy `fix`."""
        error = cls.__new__(cls, sentence)
        DualbrainError.__init__(error, f"{sentence} {fix}" if fix else sentence)
        error.what, error.got, error.allowed, error.fix = sentence, None, "", fix
        return error


class GeometryError(ConfigurationError):
    """Geometric input that cannot be used: a size, margin, pose, shape, velocity, stamp, or an array of numbers.

    `what` is the field, `got` the value as given, `allowed` the range and `fix` the remedy. The message shortens a long
    or deeply nested value.
    """

    def __init__(self, what: str, *, got: object, allowed: str, fix: str = "") -> None:
        """Report the field `what`, the value `got`, the values `allowed` and the remedy `fix`."""
        sentence = f"{what}: got {_shortened(got)}, allowed: {allowed}."
        super().__init__(what, got=got, allowed=allowed, fix=fix, sentence=sentence)


class UsageError(ConfigurationError):
    """A command that was called with arguments it cannot take."""


class MissingDependencyError(DualbrainError):
    """A dependency that a command needs and that is not installed: a package, model weights, a graphics library."""

    def __init__(self, what: str, *, fix: str) -> None:
        """Report the missing dependency `what` and the command `fix` that installs it."""
        self.what, self.fix = what, fix
        super().__init__(f"{what} is missing. {fix}")


class ChecksumError(DualbrainError):
    """A file whose content differs from the pinned content."""

    def __init__(self, name: str, *, got: str, expected: str, path: str) -> None:
        """Report the file, both SHA-256 digests, and the path last."""
        self.name, self.got, self.expected, self.path = name, got, expected, path
        super().__init__(
            f"{name}: SHA-256 is {got}, expected {expected}. The file is damaged or was replaced: "
            f"delete it and fetch it again with `dualbrain models fetch {name}`. {path}"
        )


def _shortened(value: object) -> str:
    """The representation of `value` in at most 200 characters; the name of its type if it has none."""
    try:
        return shortened_repr(value)[:200]
    except (ValueError, RecursionError):  # an integer of thousands of digits
        return f"a value of type {type(value).__name__}"
