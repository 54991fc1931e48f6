"""The kernel as a program of an emulated microcontroller (Unicorn), with exact counts of its instructions."""

from __future__ import annotations

import ctypes
import struct
import subprocess
import sys
from bisect import bisect_right
from dataclasses import dataclass
from pathlib import Path

import unicorn
from unicorn import arm_const

from tools.instruction_counts.robot_table import robot_table
from tools.kernel_limits.compiled import ROOT, run_compiler, shipped_flags

HERE = Path(__file__).parent
IMAGE_ADDRESS, IMAGE_SIZE = 0x0, 0x0020_0000
STACK_TOP, STACK_SIZE = 0x4000_0000, 0x0010_0000
STOP_ADDRESS = 0x3000_0000
MAX_OBSTACLES = 48


@dataclass(frozen=True, slots=True)
class Toolchain:
    """A compiler for Cortex-M4F."""

    name: str
    command: tuple[str, ...]


ZIG = Toolchain(
    "zig",
    (sys.executable, "-m", "ziglang", "cc", "-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m4+vfp4d16sp",
     "-fno-sanitize=all", "-fno-unwind-tables", "-fno-asynchronous-unwind-tables", "-nostdlib",
     "-g"),  # keeps the symbols at -Os
)  # fmt: skip
GCC = Toolchain(
    "gcc",
    ("arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-mthumb", "-nostdlib"),
)


def build(toolchain: Toolchain, level: str, robot: str, folder: Path, lanes: int = 1) -> Path:
    """Build the closed loop of a robot for Cortex-M4F at an optimisation level; returns the ELF file."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "robot_table.h").write_text(robot_table(robot))
    out = folder / "loop.elf"
    common = [flag for flag in shipped_flags() if not flag.startswith("-O")]
    run_compiler(
        (
            *toolchain.command, "-std=c99", level, *common, "-ffreestanding", "-ffunction-sections", "-fdata-sections",
            f"-DDBK_LANES={lanes}", f"-DDBK_MAX_OBSTACLES={MAX_OBSTACLES}", f"-I{ROOT / 'kernel/include'}",
            f"-I{ROOT / 'kernel/src'}", f"-I{folder}", "-Wl,--gc-sections", "-T", str(HERE / "image.ld"),
            "-Wl,--entry=loop_step", str(HERE / "closed_loop.c"), str(HERE / "memory_functions.c"),
            *sorted(str(path) for path in (ROOT / "kernel/src").rglob("*.c")),
            *(["-lgcc"] if toolchain is GCC else []), "-o", str(out),
        )
    )  # fmt: skip
    return out


def build_counter(folder: Path) -> ctypes.CDLL:
    """Compile the block hook for the host."""
    folder.mkdir(parents=True, exist_ok=True)
    out = folder / "block_counter.so"
    subprocess.run(["gcc", "-O2", "-shared", "-fPIC", str(HERE / "block_counter.c"), "-o", str(out)], check=True)
    return ctypes.CDLL(str(out))


class _Counter(ctypes.Structure):
    _fields_ = (
        ("code", ctypes.c_void_p),
        ("instructions", ctypes.c_uint64),
        ("executions", ctypes.c_void_p),
    )


class Emulator:
    """One loaded program; `call` runs a function, and `instructions` is the count of all calls so far."""

    def __init__(self, elf: Path, counter: ctypes.CDLL) -> None:
        image, self.symbols, self.functions = load_elf(elf.read_bytes())
        self._machine = unicorn.Uc(unicorn.UC_ARCH_ARM, unicorn.UC_MODE_THUMB | unicorn.UC_MODE_MCLASS)
        self._machine.ctl_set_cpu_model(arm_const.UC_CPU_ARM_CORTEX_M4)
        self._machine.mem_map(IMAGE_ADDRESS, IMAGE_SIZE)
        self._machine.mem_map(STACK_TOP - STACK_SIZE, STACK_SIZE)
        self._machine.mem_map(STOP_ADDRESS, 0x1000)
        self._machine.mem_write(IMAGE_ADDRESS, image)
        self._code = ctypes.create_string_buffer(image, IMAGE_SIZE)
        self._executions = (ctypes.c_uint32 * (IMAGE_SIZE // 2))()
        self._counter = _Counter(ctypes.addressof(self._code), 0, ctypes.addressof(self._executions))
        self._hook(counter)

    def _hook(self, counter: ctypes.CDLL) -> None:
        """Add the compiled hook; the Python interface of Unicorn accepts Python functions only."""
        library = unicorn.unicorn_py3.unicorn.uclib
        handle = ctypes.c_size_t()
        status = library.uc_hook_add(
            self._machine._uch,
            ctypes.byref(handle),
            unicorn.UC_HOOK_BLOCK,
            ctypes.cast(counter.count_block, ctypes.c_void_p),
            ctypes.cast(ctypes.byref(self._counter), ctypes.c_void_p),
            ctypes.c_uint64(1),
            ctypes.c_uint64(0),
        )
        assert status == 0, status

    def call(self, name: str, *arguments: int) -> int:
        """Run a function with integer arguments; returns its integer result."""
        registers = (arm_const.UC_ARM_REG_R0, arm_const.UC_ARM_REG_R1)
        for register, value in zip(registers, arguments, strict=False):
            self._machine.reg_write(register, value)
        self._machine.reg_write(arm_const.UC_ARM_REG_SP, STACK_TOP)
        self._machine.reg_write(arm_const.UC_ARM_REG_LR, STOP_ADDRESS | 1)
        self._machine.emu_start(self.symbols[name] | 1, STOP_ADDRESS)
        return int(self._machine.reg_read(arm_const.UC_ARM_REG_R0))

    @property
    def instructions(self) -> int:
        """Instructions of all calls so far."""
        return int(self._counter.instructions)

    def clear_profile(self) -> None:
        """Set the counts by function to zero."""
        ctypes.memset(self._executions, 0, ctypes.sizeof(self._executions))

    def read_integers(self, name: str, count: int = 1) -> tuple[int, ...]:
        """`count` 32-bit integers of a variable."""
        return struct.unpack(f"<{count}I", self._machine.mem_read(self.symbols[name], 4 * count))

    def profile(self) -> dict[str, int]:
        """Instructions by function since `clear_profile`."""
        found: dict[str, int] = {}
        starts = [start for start, _ in self.functions]
        for half_word, count in enumerate(self._executions):
            if count:
                name = self.functions[bisect_right(starts, 2 * half_word) - 1][1]
                found[name] = found.get(name, 0) + count
        return dict(sorted(found.items(), key=lambda item: -item[1]))


def load_elf(data: bytes) -> tuple[bytes, dict[str, int], list[tuple[int, str]]]:
    """Image of the loaded segments, address by symbol, and the functions in the order of their addresses."""
    header = struct.unpack_from("<16sHHIIIIIHHHHHH", data)
    segments_at, sections_at, n_segments, n_sections = header[5], header[6], header[10], header[12]
    image = bytearray(IMAGE_SIZE)
    for i in range(n_segments):
        kind, offset, address, _, size, *_ = struct.unpack_from("<8I", data, segments_at + 32 * i)
        if kind == 1:
            image[address : address + size] = data[offset : offset + size]
    symbols: dict[str, int] = {}
    functions: list[tuple[int, str]] = []
    sections = [struct.unpack_from("<10I", data, sections_at + 40 * i) for i in range(n_sections)]
    for section in (section for section in sections if section[1] == 2):
        names_at = sections[section[6]][4]
        for at in range(section[4], section[4] + section[5], 16):
            name_at, value, _, info, _, _ = struct.unpack_from("<IIIBBH", data, at)
            name = data[names_at + name_at : data.index(b"\0", names_at + name_at)].decode()
            symbols[name] = value & ~1 if info & 15 == 2 else value
            if info & 15 == 2:
                functions.append((value & ~1, name))
    return bytes(image), symbols, sorted(functions)
