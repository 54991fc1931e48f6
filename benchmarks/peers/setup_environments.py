"""Create the environments of the peers in build/peers, one for each file of requirements.

Run: python -m benchmarks.peers.setup_environments [--only NAME] [--oscbf GIT_URL]

Each environment stores the digest of its requirements and is created again only if they change. Environments that
could not be installed are listed at the end and excluded from the comparison; the exit code is 1 only if none exists.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import venv
from pathlib import Path

HERE = Path(__file__).resolve().parent
ENVIRONMENTS = HERE.parents[1] / "build" / "peers"
OSCBF = "https://github.com/StanfordASL/oscbf"
OSCBF_COMMIT = "6082329f8e1d61ee8e875a63a5cd80a14d513e12"
WITH_OSCBF = "cbfpy-jax-0.4.30"
"""The only environment with oscbf, which is on no package index and pins this version of JAX."""
MARK_FILE = "made-from.json"


def environment_names() -> tuple[str, ...]:
    """Return the names of all files of requirements."""
    return tuple(sorted(path.stem for path in (HERE / "requirements").glob("*.txt")))


def python_of(name: str) -> Path:
    """Return the path of the interpreter of environment `name`, whether or not it exists."""
    return ENVIRONMENTS / name / "bin" / "python"


def digest_of(name: str) -> str:
    """Return the digest of the requirements of an environment, 12 hex digits."""
    text = (HERE / "requirements" / f"{name}.txt").read_bytes() + (OSCBF_COMMIT.encode() if name == WITH_OSCBF else b"")
    return hashlib.sha256(text).hexdigest()[:12]


def is_ready(name: str) -> bool:
    """Return whether environment `name` was made from its present requirements."""
    mark = ENVIRONMENTS / name / MARK_FILE
    return mark.exists() and json.loads(mark.read_text())["digest"] == digest_of(name)


def create(name: str, oscbf: str) -> list[str]:
    """Create one environment; returns the parts that could not be installed."""
    if not python_of(name).exists():
        venv.create(ENVIRONMENTS / name, with_pip=True, clear=True)
    requirements = HERE / "requirements" / f"{name}.txt"
    if _pip(name, "-r", str(requirements)) != 0:
        return [name]
    missing = []
    if name == WITH_OSCBF and _pip(name, "--no-deps", f"git+{oscbf}@{OSCBF_COMMIT}") != 0:
        missing.append("oscbf")
    if not missing:
        (ENVIRONMENTS / name / MARK_FILE).write_text(json.dumps({"digest": digest_of(name)}))
    return missing


def _pip(name: str, *arguments: str) -> int:
    command = [str(python_of(name)), "-m", "pip", "install", "--quiet", *arguments]
    return subprocess.run(command, check=False, stdout=sys.stderr).returncode


def main() -> int:
    """Create the missing environments, and list those that could not be installed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=environment_names(), help="one environment")
    parser.add_argument("--oscbf", default=OSCBF, help="git URL with the required commit of oscbf")
    arguments = parser.parse_args()
    missing: list[str] = []
    for name in [arguments.only] if arguments.only else environment_names():
        print(f"{name}: {'ready' if is_ready(name) else 'installing'}", file=sys.stderr)
        missing += [] if is_ready(name) else create(name, arguments.oscbf)
    for name in missing:
        print(f"Could not be installed: {name}", file=sys.stderr)
    return 0 if any(python_of(name).exists() for name in environment_names()) else 1


if __name__ == "__main__":
    sys.exit(main())
