"""Strict JSON parser of the gate: bytes become one JSON value or a rejection at the syntax stage, without repairs."""

from __future__ import annotations

import json
import re
from typing import Any, NoReturn

from dualbrain.contracts.verdict import Rejected
from dualbrain.core.text import to_printable
from dualbrain.errors import DualbrainError

MAX_BYTES = 64 * 1024
MAX_CONTRACT_FILE_BYTES = 1 << 20
"""Largest file that is read as a contract: more than the gate accepts, so that it is the gate that refuses it."""
MAX_DEPTH = 16
MAX_FIELDS = 64
"""Maximum number of fields of an object: above that of any skill, and small enough for a fast rejection."""
MAX_COMMAS = 1024
"""Maximum number of commas outside strings: several times that of the longest contract. It bounds the number of values,
and with it the time of every later step."""
MAX_INT_DIGITS = 15
"""Maximum number of digits of an integer; integers of up to 15 digits are exact in double precision."""
MAX_FLOAT_LENGTH = 40

_ESCAPE_PATTERN = re.compile(rb"\\.", re.DOTALL)
_ALL_BUT_BRACKETS = bytes(set(range(256)) - set(b'[]{}"'))
_ALL_BUT_COMMAS = bytes(set(range(256)) - set(b',"'))
"""Bytes that `_outside_strings` drops; quotes stay, because they show where a string begins and ends."""
_DEPTH_CHANGE = {ord("["): 1, ord("{"): 1, ord("]"): -1, ord("}"): -1}


class _RejectedError(DualbrainError):
    """Carries a rejection out of the hooks of the JSON decoder; never leaves this module."""

    def __init__(self, rejection: Rejected) -> None:
        super().__init__(rejection.hint)
        self.rejection = rejection


def parse(data: bytes) -> Any:
    """The JSON value in `data`, or `Rejected` at the syntax stage; never raises, for any bytes.

    Conditions, in this order: at most 64 KiB; strict UTF-8 without byte order mark; outside strings, at most 1024
    commas, and brackets at most 16 deep; RFC 8259 JSON; objects with at most 64 fields and no duplicate; no NaN or
    infinity, literally or by overflow; integers of at most 15 digits; no lone surrogates. (`json.loads` alone accepts
    NaN, duplicate keys and lone surrogates, and reads 1e999 as infinity.)
    """
    if len(data) > MAX_BYTES:
        return _reject(len(data), f"at most {MAX_BYTES} bytes", "send one contract and nothing else")
    try:
        return _decode(data)
    except _RejectedError as error:
        return error.rejection
    except UnicodeDecodeError as error:
        return _reject(f"byte 0x{data[error.start]:02x} at {error.start}", "strict UTF-8", "encode the text as UTF-8")
    except UnicodeEncodeError:
        return _reject("lone surrogate escape", "Unicode text", "write surrogate escapes in pairs")
    except json.JSONDecodeError as error:
        where = f"line {error.lineno}, column {error.colno}"
        near = to_printable(error.doc[error.pos : error.pos + 20])
        return _reject(near, "one JSON object (RFC 8259)", f"{error.msg} at {where}")


def _decode(data: bytes) -> Any:
    """The value in `data`; raises the exceptions that `parse` turns into rejections."""
    text = data.decode("utf-8", "strict")
    if data.count(b",") > MAX_COMMAS and (n_commas := len(_outside_strings(data, _ALL_BUT_COMMAS))) > MAX_COMMAS:
        raise _RejectedError(
            _reject(f"{n_commas} commas", f"at most {MAX_COMMAS} commas outside strings", "send fewer values")
        )
    if _is_too_deep(_outside_strings(data, _ALL_BUT_BRACKETS)):
        raise _RejectedError(
            _reject(f"deeper than {MAX_DEPTH}", f"brackets at most {MAX_DEPTH} deep", "a contract is 5 deep")
        )
    value = _DECODER.decode(text)
    if b"\\u" in data:
        json.dumps(value, ensure_ascii=False).encode("utf-8", "strict")
    return value


def _outside_strings(data: bytes, dropped: bytes) -> bytes:
    """The bytes of `data` that are outside strings and not `dropped`.

    The result is exact for every text that begins as JSON, because quotes are paired as the decoder pairs them. The
    time is linear in the size of the data.
    """
    if b"\\" in data:
        data = _ESCAPE_PATTERN.sub(b"", data)
    kept = data.translate(None, dropped).replace(b'""', b"")  # a string in which every byte is dropped
    return b"".join(kept.split(b'"')[::2]) if b'"' in kept else kept


def _is_too_deep(brackets: bytes) -> bool:
    """Whether `brackets` nest deeper than `MAX_DEPTH`."""
    if _is_shallow(brackets):
        return False
    depth = 0
    for bracket in brackets:
        depth += _DEPTH_CHANGE[bracket]
        if depth > MAX_DEPTH:
            return True
    return False


def _is_shallow(brackets: bytes) -> bool:
    """Whether removing closed pairs shows that `brackets` nest at most `MAX_DEPTH` deep: a fast test, not an exact one.

    To remove pairs that are next to each other makes the text at most one level less deep.
    """
    for _ in range(MAX_DEPTH // 2):
        length = len(brackets)
        brackets = brackets.replace(b"{}", b"").replace(b"[]", b"")
        if len(brackets) in (0, length):
            break
    return not brackets


def _reject(got: object, allowed: str, hint: str) -> Rejected:
    """A rejection of the whole document."""
    return Rejected(stage="syntax", pointer="", got=got, allowed=allowed, hint=hint)


def _parse_object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object, unless it has too many fields or a duplicate key (JSON readers differ on which duplicate they use)."""
    if len(pairs) > MAX_FIELDS:
        raise _RejectedError(
            _reject(f"object of {len(pairs)}", f"at most {MAX_FIELDS} fields in an object", "drop fields")
        )
    members = dict(pairs)
    if len(members) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))
        raise _RejectedError(_reject(to_printable(twice), "each key once in an object", "drop the duplicate key"))
    return members


def _parse_float(literal: str) -> float:
    """A finite double; rejects long literals and values beyond ±1e300."""
    value = float(literal)
    if len(literal) > MAX_FLOAT_LENGTH or not -1e300 <= value <= 1e300:
        raise _RejectedError(
            _reject(to_printable(literal), "numbers within 1e300 in at most 40 characters", "write a plain number")
        )
    return value


def _parse_int(literal: str) -> int:
    """An integer that double precision represents exactly."""
    if len(literal) > MAX_INT_DIGITS and len(literal.lstrip("-")) > MAX_INT_DIGITS:
        raise _RejectedError(
            _reject(to_printable(literal), f"whole numbers of at most {MAX_INT_DIGITS} digits", "write a plain number")
        )
    return int(literal)


def _reject_constant(literal: str) -> NoReturn:
    """Reject NaN and infinities, which are not JSON and cannot be compared with bounds."""
    raise _RejectedError(_reject(literal, "finite numbers", "write a plain number"))


_DECODER = json.JSONDecoder(
    object_pairs_hook=_parse_object,
    parse_float=_parse_float,
    parse_int=_parse_int,
    parse_constant=_reject_constant,
    strict=True,
)
