"""Compiles C files of the firmware into a shared library of the host, for tests through ctypes."""

import ctypes
import subprocess

from dualbrain.safety.target.build import source_root

ROOT = source_root()
INCLUDES = [f"-I{ROOT / folder}" for folder in ("kernel/include", "kernel/src", "firmware")]
WARNINGS = ["-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wshadow", "-Wdouble-promotion", "-Werror"]


def load_library(folder, *sources, flags=()):
    """The library of the given files, relative to the root, compiled with `flags` and with warnings as errors."""
    path = folder / "library.so"
    files = [str(ROOT / source) for source in sources]
    command = ["gcc", "-std=c99", "-O1", "-shared", "-fPIC", *flags, *WARNINGS, *INCLUDES, *files, "-o", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(path))
