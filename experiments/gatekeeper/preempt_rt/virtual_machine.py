"""A virtual machine without any operating system around the kernel: its first process is the program.

QEMU counts instructions (-icount): one instruction takes one nanosecond of the machine's time, and idle time passes at
once, so that the load of the host delays nothing.
"""

from __future__ import annotations

import gzip
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from dualbrain.errors import ConfigurationError, MissingDependencyError

EMULATOR = "qemu-system-x86_64"
MACHINE = "-accel tcg -icount shift=0,sleep=off -cpu max -M q35 -m 512 -smp 1 -nographic -no-reboot"
"""No KVM: a processor of the host would run by its own clock."""
KERNEL_ARGUMENTS = "console=ttyS0 quiet panic=-1"
TIMEOUT_S = 3600.0
"""Longest time of one run [s]; it takes minutes."""
EXECUTABLE, REGULAR_FILE = 0o755, 0o100000
END_OF_ARCHIVE = "TRAILER!!!"


def find_emulator() -> str:
    """Path of the emulator.

    Raises:
        MissingDependencyError: it is not installed.
    """
    program = shutil.which(EMULATOR)
    if program is None:
        raise MissingDependencyError(f"The emulator {EMULATOR}", fix="On Debian: apt-get install qemu-system-x86")
    return program


def run_machine(kernel: Path, program: Path, arguments: Sequence[str]) -> str:
    """Start `kernel` with `program` as its first process; returns the text of the console after it switched off.

    Raises:
        MissingDependencyError: the emulator is not installed.
        ConfigurationError: the emulator failed, or the machine did not switch off in time.
    """
    root_files = program.with_name("root_files.gz")
    root_files.write_bytes(gzip.compress(pack_archive({"init": program.read_bytes()}), mtime=0))
    command = [find_emulator(), *MACHINE.split(), "-kernel", str(kernel), "-initrd", str(root_files)]
    command += ["-append", f"{KERNEL_ARGUMENTS} -- {' '.join(arguments)}"]
    try:
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, check=False, timeout=TIMEOUT_S, cwd=program.parent
        )
    except subprocess.TimeoutExpired as late:
        end = (late.stdout or b"").decode(errors="replace")[-1000:]
        raise ConfigurationError.stating(
            f"The virtual machine did not switch off within {TIMEOUT_S:.0f} s.", fix=f"The console ends with:\n{end}"
        ) from late
    if done.returncode != 0:
        fix = f"It reported:\n{done.stderr.decode(errors='replace')[-1000:]}"
        raise ConfigurationError.stating(f"{EMULATOR} ended with exit code {done.returncode}.", fix=fix)
    return done.stdout.decode(errors="replace")


def pack_archive(files: dict[str, bytes]) -> bytes:
    """Executable files by name as an archive (format newc), which the kernel unpacks into its first file system."""
    entries = [_entry(number, name, content) for number, (name, content) in enumerate(files.items(), start=1)]
    return b"".join([*entries, _entry(0, END_OF_ARCHIVE, b"", mode=0)])


def _entry(number: int, name: str, content: bytes, mode: int = REGULAR_FILE | EXECUTABLE) -> bytes:
    """Header, name and content; both end at a multiple of four bytes."""
    links, size = 1, len(content)
    fields = (number, mode, 0, 0, links, 0, size, 0, 0, 0, 0, len(name) + 1, 0)
    head = "070701" + "".join(f"{field:08x}" for field in fields) + name + "\0"
    return _padded(head.encode()) + _padded(content)


def _padded(content: bytes) -> bytes:
    return content + bytes(-len(content) % 4)
