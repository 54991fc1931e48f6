"""What is committed stays small, whoever commits it and with whatever hooks."""

import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LARGEST = 600_000
PACKAGED = "src/dualbrain/adaptation/packaged/*/adapter_model.safetensors"
"""What a hook lets through, too: `tests/adaptation/adapters/test_packaged.py` holds these to 5 MB."""


def test_no_large_file_is_committed():
    found = subprocess.run(["git", "-C", ROOT, "ls-files", "-z"], capture_output=True, check=True, text=True).stdout
    names = [Path(name) for name in found.split("\0") if name and (ROOT / name).is_file()]
    assert Path("pyproject.toml") in names
    assert not [str(name) for name in names if (ROOT / name).stat().st_size > LARGEST and not name.match(PACKAGED)]
