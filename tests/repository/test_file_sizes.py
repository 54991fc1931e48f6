"""Committed files stay small, also if they were committed without the pre-commit hooks."""

import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MAX_BYTES = 600_000
PACKAGED = "src/dualbrain/adaptation/packaged/*/adapter_model.safetensors"
"""Exempt here and in the hook; `tests/adaptation/adapters/test_packaged.py` limits these files to 5 MB."""
ANIMATION, MAX_ANIMATION_BYTES = "docs/images/demo.gif", 4_000_000
"""The animation of the README, exempt here and in the hook, and its own limit."""


def test_no_large_file_is_committed():
    listed = subprocess.run(["git", "-C", ROOT, "ls-files", "-z"], capture_output=True, check=True, text=True).stdout
    names = [Path(name) for name in listed.split("\0") if name and (ROOT / name).is_file()]
    assert Path("pyproject.toml") in names
    large = [name for name in names if (ROOT / name).stat().st_size > MAX_BYTES]
    assert not [str(name) for name in large if not name.match(PACKAGED) and not name.match(ANIMATION)]


def test_the_animation_of_the_readme_is_small_enough():
    assert (ROOT / ANIMATION).stat().st_size <= MAX_ANIMATION_BYTES
