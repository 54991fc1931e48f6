"""Reader of object files: functions, references between them, stack sizes. ELF, little endian, 32 or 64 bit."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

SYMTAB, RELA, REL = 2, 4, 9
FUNCTION, SECTION = 2, 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """One section of an object file, with the fields of its header and its bytes."""

    name: str
    kind: int
    link: int
    info: int
    data: bytes


@dataclass(slots=True, kw_only=True)
class ObjectFile:
    """Functions of an object: code sizes, calls, undefined symbols, taken addresses, stack sizes; sizes in bytes."""

    path: Path
    code: dict[str, int] = field(default_factory=dict)
    calls: dict[str, set[str]] = field(default_factory=dict)
    undefined: set[str] = field(default_factory=set)
    addresses_taken: set[str] = field(default_factory=set)
    stack: dict[str, int] = field(default_factory=dict)


def read_object(path: Path) -> ObjectFile:
    """Read an object that was compiled with -ffunction-sections, so that each function has its own section."""
    raw = path.read_bytes()
    wide = raw[4] == 2
    sections = _sections(raw, wide)
    out = ObjectFile(path=path)
    symbols = next((_symbols(s, sections[s.link], wide) for s in sections if s.kind == SYMTAB), [])
    home = {i: _function(s.name) for i, s in enumerate(sections) if _function(s.name)}
    for name, kind, section, size in symbols:
        if section == 0 and name:
            out.undefined.add(name)
        elif kind == FUNCTION and section in home:
            out.code[name] = size
    for section in sections:
        if section.kind in (REL, RELA):
            _references(section, sections, symbols, home, wide, out)
        elif section.name == ".stack_sizes" and section.link in home:
            out.stack[home[section.link]] = _uleb(section.data[8 if wide else 4 :])
    return out


def _sections(raw: bytes, wide: bool) -> list[Section]:
    if wide:
        start, (size, count, names) = struct.unpack_from("<Q", raw, 40)[0], struct.unpack_from("<HHH", raw, 58)
    else:
        start, (size, count, names) = struct.unpack_from("<I", raw, 32)[0], struct.unpack_from("<HHH", raw, 46)
    heads = [struct.unpack_from("<IIQQQQIIQQ" if wide else "<10I", raw, start + i * size) for i in range(count)]
    text = raw[heads[names][4] : heads[names][4] + heads[names][5]]
    return [
        Section(name=_string(text, h[0]), kind=h[1], link=h[6], info=h[7], data=raw[h[4] : h[4] + h[5] * (h[1] != 8)])
        for h in heads
    ]


def _symbols(section: Section, strings: Section, wide: bool) -> list[tuple[str, int, int, int]]:
    out = []
    for entry in struct.iter_unpack("<IBBHQQ" if wide else "<IIIBBH", section.data):
        name, info, home, size = (
            (entry[0], entry[1], entry[3], entry[5]) if wide else (entry[0], entry[3], entry[5], entry[2])
        )
        out.append((_string(strings.data, name), info & 15, home, size))
    return out


def _references(
    section: Section,
    sections: list[Section],
    symbols: list[tuple[str, int, int, int]],
    home: dict[int, str],
    wide: bool,
    out: ObjectFile,
) -> None:
    """Add references to `out`: from a function they are calls, from other data they take the address of a function."""
    layout = {(True, RELA): "<QQq", (True, REL): "<QQ", (False, RELA): "<IIi", (False, REL): "<II"}[wide, section.kind]
    caller, source = home.get(section.info), sections[section.info].name
    for entry in struct.iter_unpack(layout, section.data):
        name, kind, where, _ = symbols[entry[1] >> (32 if wide else 8)]
        target = home.get(where) if where else name
        if not target or kind not in (FUNCTION, SECTION, 0):
            continue
        if caller is not None:
            out.calls.setdefault(caller, set()).add(target)
        elif not source.startswith((".eh_frame", ".stack_sizes", ".debug", ".ARM")):
            out.addresses_taken.add(target)


def _function(name: str) -> str:
    """Return the function of a code section without the number of a compiler clone; "" for other sections."""
    for start in (".text.unlikely.", ".text."):
        if name.startswith(start):
            return strip_clone_suffix(name.removeprefix(start))
    return ""


def strip_clone_suffix(name: str) -> str:
    """Remove the number of a compiler clone, as the stack report does: `constraint.isra.0` -> `constraint.isra`."""
    head, _, tail = name.rpartition(".")
    return head if tail.isdigit() else name


def _string(data: bytes, at: int) -> str:
    return data[at : data.index(b"\0", at)].decode()


def _uleb(data: bytes) -> int:
    value = 0
    for shift, byte in enumerate(data):
        value |= (byte & 127) << (7 * shift)
        if byte < 128:
            break
    return value
