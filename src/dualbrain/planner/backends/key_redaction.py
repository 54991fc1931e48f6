"""Removal of an API key from everything that a server sends, also in the usual encodings of it.

A server that repeats the key must not write it into records, logs or the memory, in any of its fields. A server
that is determined to hide the key can always invent one more encoding: the removal covers the encodings that programs
use by themselves.
"""

from __future__ import annotations

import base64
import json
import re
from typing import Any, cast

REDACTED = "[key]"
"""Replaces the key, and a whole text that has the key in an encoded form."""
MIN_KEY_CHARACTERS = 4
"""A shorter key is a placeholder for a server that needs none ("x", "sk"), and occurs in ordinary words."""
MIN_ENCODED_CHARACTERS = 6
"""Encoded forms of a shorter key are not searched: they occur by chance."""

HIDDEN = "[not shown]"
"""Replaces the part of an address that may contain a secret."""
_HOST_AND_PORT = re.compile(r"(?:\[[^\[\]]*\]|[^:]*)(?::[0-9]*)?")
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*")
_API_VERSION = re.compile(r"\?api-version=[0-9A-Za-z.-]*\Z")

_ESCAPE = re.compile(
    r"\\{1,8}(?:[uU]0{2,6}|[uU]\{0{0,6}|[xX])([0-9a-fA-F]{2})\}?"  # JSON, JavaScript, Python
    r"|\\{1,8}([0-7]{3})"  # C
    r"|%(?:25){0,4}([0-9a-fA-F]{2})"  # addresses, also encoded several times
    r"|&#0{0,8}([0-9]{2,3});?|&#[xX]0{0,8}([0-9a-fA-F]{2});?"  # HTML
)
"""One escaped ASCII character. All repetitions are bounded, so that the search is linear."""
_ESCAPE_BASES = (16, 8, 16, 10, 16)
_MAX_ESCAPE_ROUNDS = 3
_SEPARATORS = (
    "".join(map(chr, (*range(0x21), *range(0x7F, 0xA1)))) + "\"'`\\+,|\xad\u034f\u061c\u115f\u1160\u3164\uffa0"
)
_SEPARATOR_RANGES = ((0x180B, 0x180F), (0x2000, 0x200F), (0x2028, 0x202F), (0x205F, 0x206F), (0xFE00, 0xFE0F))
_NORMAL_FORM: dict[int, int | None] = (
    {ord(character): None for character in (*_SEPARATORS, "\ufeff", "\u2800", "\u3000")}
    | {code: None for first, last in (*_SEPARATOR_RANGES, (0xE0000, 0xE01EF)) for code in range(first, last + 1)}
    | {code: code + 32 for code in range(ord("A"), ord("Z") + 1)}
    | {0xFEE0 + code: None if chr(code) in _SEPARATORS else ord(chr(code).lower()) for code in range(0x21, 0x7F)}
)
"""Without separators and invisible characters, in lower case, full-width letters as ASCII."""


class KeyRedactor:
    """Removes one API key from texts and from bodies of responses; an empty or very short key is no secret."""

    def __init__(self, key: str) -> None:
        self._key = key if len(key) >= MIN_KEY_CHARACTERS else ""
        self._encoded_forms = _encoded_forms(self._key) if len(self._key) >= MIN_ENCODED_CHARACTERS else ()

    def redact_text(self, text: str) -> str:
        """`text` without the key. A text that has the key in an encoded form is replaced as a whole.

        Takes time proportional to the length of `text`.
        """
        if not self._key:
            return text
        text = text.replace(self._key, REDACTED)
        return REDACTED if self._has_encoded_key(text) else text

    def redact_body(self, body: bytes) -> bytes:
        """`body` without the key in any string, name or number of its JSON, or in its text if it is not JSON."""
        if not self._key:
            return body
        body = body.replace(self._key.encode(errors="replace"), REDACTED.encode())
        try:
            tree = json.loads(body)
            redacted = self._redact_value(tree)
            return body if redacted == tree else json.dumps(redacted, separators=(",", ":")).encode()
        except (ValueError, RecursionError):  # not JSON, or nested too deeply to be read value by value
            text = body.decode("utf-8", "replace")
            redacted = self.redact_text(text)
            return body if redacted == text else redacted.encode()

    def _redact_value(self, value: Any) -> Any:
        match value:
            case str():
                return self.redact_text(value)
            case dict():
                entries = cast("dict[str, Any]", value).items()
                return {self.redact_text(name): self._redact_value(entry) for name, entry in entries}
            case list():
                return [self._redact_value(entry) for entry in cast("list[Any]", value)]
            case int() | float() if self._key in repr(value):
                return None
            case _:
                return value

    def _has_encoded_key(self, text: str) -> bool:
        for _ in range(_MAX_ESCAPE_ROUNDS):
            normal = text.translate(_NORMAL_FORM)
            if any(form in normal for form in self._encoded_forms):
                return True
            decoded = _ESCAPE.sub(_decode_escape, text)
            if decoded == text:
                return False
            text = decoded
        normal = text.translate(_NORMAL_FORM)
        return any(form in normal for form in self._encoded_forms)


def public_address(url: str) -> str:
    """`url` without user name, password and query, which may be secrets, and without a fragment.

    A sign such as / in a password ends the host too early: an address with @ behind its host, or with a port that is no
    number, shows no more than its scheme.
    """
    scheme, separator, rest = url.partition("://") if "://" in url else ("", "", url)
    if separator and not _SCHEME.fullmatch(scheme):
        return HIDDEN
    authority = re.split("[/?#]", rest, maxsplit=1)[0]
    host, tail = authority.rpartition("@")[2] if separator else authority, rest[len(authority) :]
    if "@" in host + tail or not _HOST_AND_PORT.fullmatch(host):
        return scheme + separator + HIDDEN
    return scheme + separator + host + re.split("[?#]", tail, maxsplit=1)[0]


def public_planner(name: str) -> str:
    """The name of a planner as it may be printed and recorded: its address, if it has one, as `public_address`."""
    prefix, whole = _split_address(name)
    address, mark, fragment = whole.partition("#")
    shown = public_address(address) if whole else ""
    return prefix + shown + (mark + fragment if HIDDEN not in shown else "")


def _split_address(name: str) -> tuple[str, str]:
    """What is before the address in the name of a planner (a dialect, a candidate in shadow), and the address or ""."""
    before, separator, _ = name.partition("://")
    start = max(before.rfind("+"), before.rfind("@")) + 1 if separator else len(name)
    return name[:start], name[start:]


def has_secret_parts(name: str) -> bool:
    """Whether the address in the name of a planner has a user name, or a query with more than a version of the API."""
    address = _split_address(name)[1].partition("#")[0]
    return public_address(address) != _API_VERSION.sub("", address)


def _encoded_forms(key: str) -> tuple[str, ...]:
    """Normal forms of the key itself, in hexadecimal and in Base64, wherever it begins in the encoded text."""
    data = key.encode(errors="replace")
    forms = {key, data.hex()}
    for offset in range(3):
        encoded = base64.b64encode(b"\0" * offset + data).decode()
        certain = encoded[-(-8 * offset // 6) : 8 * (offset + len(data)) // 6]  # independent of the text around the key
        forms |= {certain, certain.replace("+", "-").replace("/", "_")}
    normal = (form.translate(_NORMAL_FORM) for form in sorted(forms))
    return tuple(form for form in normal if len(form) >= MIN_ENCODED_CHARACTERS)


def _decode_escape(escape: re.Match[str]) -> str:
    group = escape.lastindex or 1
    return chr(int(escape[group], _ESCAPE_BASES[group - 1]))
