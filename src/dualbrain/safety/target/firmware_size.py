"""Size of firmware in the memories of a target, from the program headers of its ELF file (32 bit, little endian)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from struct import Struct

from dualbrain.errors import ConfigurationError

_HEADER, _SEGMENT = Struct("<4sBB10xHHIIIIIHHH"), Struct("<8I")
LOADED, WRITABLE = 1, 2


@dataclass(frozen=True, slots=True)
class FirmwareSize:
    """Bytes in the flash memory and in the RAM, without the stack."""

    flash: int
    ram: int


def firmware_size(elf: Path) -> FirmwareSize:
    """The size of the firmware in `elf`.

    Raises:
        ConfigurationError: the file is no ELF file of a 32 bit processor.
    """
    data = elf.read_bytes()
    head = _HEADER.unpack_from(data.ljust(_HEADER.size, b"\0"))
    magic, bits, order, _, _, _, _, start, _, _, _, size, count = head
    if (magic, bits, order) != (b"\x7fELF", 1, 1):
        raise ConfigurationError("format of the firmware", got=elf.name, allowed="an ELF file of a 32 bit processor")
    segments = [_SEGMENT.unpack_from(data, start + size * i) for i in range(count)]
    loaded = [segment for segment in segments if segment[0] == LOADED]
    flash = sum(in_file for _, _, _, _, in_file, _, _, _ in loaded)
    return FirmwareSize(flash, sum(memory for *_, memory, flags, _ in loaded if flags & WRITABLE))
