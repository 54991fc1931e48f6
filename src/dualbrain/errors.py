"""Exceptions for broken set-ups and wrong programs.

Expected refusals (a rejected contract, a stopped filter) are values, never exceptions. What is raised here says what is
wrong, what was got, what is allowed and what to do, and carries the same facts as attributes.
"""

from difflib import get_close_matches

import msgspec

DECODE_ERRORS = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)
"""What is raised for bytes that are not what they should be: text that is no UTF-8 and nesting without end are passed
on by msgspec as Python has them. Whoever reads what others wrote catches all three."""


class DualbrainError(Exception):
    """Root of every exception that dualbrain raises on purpose."""


class UnknownNameError(DualbrainError):
    """A name that is not in the closed set it must come from."""

    def __init__(self, kind: str, name: str, known: tuple[str, ...], *, owner: str = "") -> None:
        """Say which `kind` of thing was asked for, by what `name`, and which names `owner` knows."""
        self.kind, self.name, self.known, self.owner = kind, name, tuple(sorted(known)), owner
        close = get_close_matches(name, self.known, n=1)
        hint = f" Closest: {close[0]!r}." if close else ""
        of = f" of {owner}" if owner else ""
        article = "an" if kind[:1] in "aeiou" else "a"
        super().__init__(f"{name!r} is not {article} {kind}{of}.{hint} Known: {', '.join(self.known) or 'none'}.")


class ConfigurationError(DualbrainError):
    """A configuration or data file that cannot be used; says what, got, allowed and how to mend it."""

    def __init__(self, what: str, *, got: object, allowed: str, fix: str = "") -> None:
        """Name the setting, the value found, the values allowed and the mend."""
        self.what, self.got, self.allowed, self.fix = what, got, allowed, fix
        super().__init__(f"{what}: got {got!r}, allowed: {allowed}." + (f" {fix}" if fix else ""))


class UsageError(ConfigurationError):
    """A command called with words it cannot take."""


class MissingDependencyError(DualbrainError):
    """Something the command needs is not installed here (a package, weights, a graphics library)."""

    def __init__(self, what: str, *, fix: str) -> None:
        """Name the missing part and the command that installs it."""
        self.what, self.fix = what, fix
        super().__init__(f"{what} is missing. {fix}")


class ChecksumError(DualbrainError):
    """A file whose content is not the one that was pinned."""

    def __init__(self, name: str, *, got: str, expected: str, path: str) -> None:
        """Name the file, both SHA-256 digests and, last, where it lies."""
        self.name, self.got, self.expected, self.path = name, got, expected, path
        super().__init__(
            f"{name}: SHA-256 is {got}, expected {expected}. The file is damaged or was replaced: "
            f"delete it and fetch it again with `dualbrain models fetch {name}`. {path}"
        )
