"""Virtual environments without dualbrain, for software whose requirements conflict with ours; each below build/.

An environment is used again if it was created from the same sources, which a digest beside it records.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
import sysconfig
import venv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dualbrain.errors import MissingDependencyError

BUILD = Path(__file__).resolve().parents[2] / "build"
PRESENT = sysconfig.get_path("purelib")
"""Packages of the environment that runs this program."""
MARK = "made-from"
"""File with the digest of the sources of an environment."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VirtualEnvironment:
    """The environment `folder`/venv of the software `title`, created by the command line `command`.

    `sources` are the files from which it is created, the first one its requirements; `version` names what else is.
    """

    title: str
    folder: Path
    command: str
    sources: tuple[Path, ...]
    version: str = ""

    @property
    def digest(self) -> str:
        """Digest of the sources, 12 hex digits."""
        content = b"".join(path.read_bytes() for path in self.sources) + self.version.encode()
        return hashlib.sha256(content).hexdigest()[:12]

    @property
    def packages(self) -> list[str]:
        """The required packages with their versions."""
        lines = self.sources[0].read_text().splitlines()
        return [line for line in lines if line and not line.startswith("#")]

    def interpreter(self) -> Path:
        """The interpreter.

        Raises `MissingDependencyError` unless it exists and was created from the present sources.
        """
        mark, python = self.folder / MARK, self._python
        if not (mark.exists() and mark.read_text() == self.digest and python.exists()):
            fix = f"Create it with `{self.command}` (needs a package index)."
            raise MissingDependencyError(f"The virtual environment of {self.title}", fix=fix)
        return python

    def create(self, install: Callable[[], object]) -> Path:
        """Create the environment unless it exists, and fill it with `install`; returns its interpreter.

        Raises:
            MissingDependencyError: `install` could not install a package.
        """
        try:
            return self.interpreter()
        except MissingDependencyError:
            print(f"installing into {self.folder.name}/venv: {', '.join(self.packages)}", file=sys.stderr)
        venv.create(self.folder / "venv", with_pip=True, clear=True)
        install()
        (self.folder / MARK).write_text(self.digest)
        return self._python

    def pip(self, *arguments: str) -> None:
        """Run pip in the environment; raises `MissingDependencyError` if it fails. Its output is on stderr."""
        command = [str(self._python), "-m", "pip", arguments[0], "--quiet", *arguments[1:]]
        if subprocess.run(command, check=False, stdout=sys.stderr).returncode != 0:
            fix = "pip could not install it (see its output above); check that a package index is reachable."
            raise MissingDependencyError(f"{self.title} ({' '.join(arguments)})", fix=fix)

    def share_present_packages(self) -> None:
        """Take packages that are missing here, dualbrain included, from the environment that runs this program."""
        packages = next((self.folder / "venv" / "lib").glob("python*/site-packages"))
        (packages / "present.pth").write_text(f"import site; site.addsitedir({PRESENT!r})\n")

    @property
    def _python(self) -> Path:
        return self.folder / "venv" / "bin" / "python"


def run_creation(create: Callable[[], object]) -> None:
    """Create an environment from the command line; a missing package ends the program with its message."""
    try:
        create()
    except MissingDependencyError as missing:
        sys.exit(str(missing))
