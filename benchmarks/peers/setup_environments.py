"""Create the peers' environments below build/peers, one for each file of requirements.

Run: python benchmarks/peers/setup_environments.py [--only NAME] [--oscbf GIT_URL]

What is done is not done again: an environment carries the digest of the requirements that it was made from. What could
not be installed is named at the end and left out of the comparison; the exit code is 1 only when nothing is there.
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
"""oscbf is on no package index; it pins this JAX and needs its own list of old parts, which is why it is only here."""
MARK_FILE = "made-from.json"


def environment_names() -> tuple[str, ...]:
    """Every environment there is a file of requirements for."""
    return tuple(sorted(path.stem for path in (HERE / "requirements").glob("*.txt")))


def python_of(name: str) -> Path:
    """The interpreter of environment `name`, whether or not it exists."""
    return ENVIRONMENTS / name / "bin" / "python"


def digest_of(name: str) -> str:
    """What the environment was made from, 12 hex."""
    text = (HERE / "requirements" / f"{name}.txt").read_bytes() + (OSCBF_COMMIT.encode() if name == WITH_OSCBF else b"")
    return hashlib.sha256(text).hexdigest()[:12]


def is_ready(name: str) -> bool:
    """Was `name` made from the requirements as they are now?"""
    mark = ENVIRONMENTS / name / MARK_FILE
    return mark.exists() and json.loads(mark.read_text())["digest"] == digest_of(name)


def create(name: str, oscbf: str) -> list[str]:
    """Make one environment; returns what could not be installed."""
    if not python_of(name).exists():
        venv.create(ENVIRONMENTS / name, with_pip=True, clear=True)
    wanted = HERE / "requirements" / f"{name}.txt"
    if _pip(name, "-r", str(wanted)) != 0:
        return [name]
    missing = []
    if name == WITH_OSCBF and _pip(name, "--no-deps", f"git+{oscbf}@{OSCBF_COMMIT}") != 0:
        missing.append("oscbf")
    if not missing:
        (ENVIRONMENTS / name / MARK_FILE).write_text(json.dumps({"digest": digest_of(name)}))
    return missing


def _pip(name: str, *wanted: str) -> int:
    command = [str(python_of(name)), "-m", "pip", "install", "--quiet", *wanted]
    return subprocess.run(command, check=False, stdout=sys.stderr).returncode


def main() -> int:
    """Make what is missing, and say what could not be made."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=environment_names(), help="one environment")
    parser.add_argument("--oscbf", default=OSCBF, help="git address that has oscbf's commit")
    arguments = parser.parse_args()
    missing: list[str] = []
    for name in [arguments.only] if arguments.only else environment_names():
        print(f"{name}: {'ready' if is_ready(name) else 'installing'}", file=sys.stderr)
        missing += [] if is_ready(name) else create(name, arguments.oscbf)
    for name in missing:
        print(f"could not be installed: {name}", file=sys.stderr)
    return 0 if any(python_of(name).exists() for name in environment_names()) else 1


if __name__ == "__main__":
    sys.exit(main())
