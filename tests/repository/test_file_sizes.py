"""Committed files stay small, also if they were committed without the pre-commit hooks."""

import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MAX_BYTES = 600_000
PACKAGED = "src/dualbrain/adaptation/packaged/*/adapter_model.safetensors"
"""Exempt here and in the hook; `tests/adaptation/adapters/test_packaged.py` limits these files to 5 MB."""
ANIMATIONS, MAX_ANIMATION_BYTES = ("docs/images/*.gif", "docs/images/*.mp4"), 4_000_000
"""The animations of the documentation, exempt here and in the hook, and their own limit."""


def test_no_large_file_is_committed():
    listed = subprocess.run(["git", "-C", ROOT, "ls-files", "-z"], capture_output=True, check=True, text=True).stdout
    names = [Path(name) for name in listed.split("\0") if name and (ROOT / name).is_file()]
    assert Path("pyproject.toml") in names
    large = [name for name in names if (ROOT / name).stat().st_size > MAX_BYTES]
    assert not [str(name) for name in large if not any(name.match(one) for one in (PACKAGED, *ANIMATIONS))]


def test_the_animations_are_small_enough():
    found = [path for pattern in ANIMATIONS for path in ROOT.glob(pattern)]
    assert {path.name for path in found} >= {"filter.gif", "filter.mp4"}
    assert [path for path in found if path.stat().st_size > MAX_ANIMATION_BYTES] == []
