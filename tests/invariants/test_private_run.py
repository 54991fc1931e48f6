"""A run with the umask 0 leaves nothing that another user can open, simulated or behind a gatekeeper."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from tests.stories.story_session import hold_contract

pytestmark = pytest.mark.llm

COMMAND = [sys.executable, *(("-S",) if sys.flags.no_site else ()), "-m", "dualbrain"]


@pytest.mark.parametrize("options", [(), pytest.param(("--live",), marks=pytest.mark.realtime)])
def test_a_run_is_private(tmp_path: Path, options: tuple[str, ...]) -> None:
    home = tmp_path / "home"
    home.mkdir(mode=0o755)
    (home / "ledger.sqlite").touch(mode=0o644)
    contract = tmp_path / "c.json"
    contract.write_text(hold_contract())
    (tmp_path / "t").mkdir(mode=0o755)
    environment = os.environ | {"DUALBRAIN_HOME": str(home), "TMPDIR": str(tmp_path / "t")}
    words = ["run", "--contract", str(contract), "--headless", "--scene", "bare:0", "--out", "runs/one"]
    done = subprocess.run(
        [*COMMAND, *words, *options],
        cwd=tmp_path,
        env=environment,
        umask=0,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode in (0, 1, 6), done.stderr
    created = [path for top in (home, tmp_path / "runs") for path in (top, *top.rglob("*"))]
    names = {path.name for path in created}
    assert {"ledger.sqlite", "ledger.sqlite.anchor", "episode.mcap", "report.html", "ledger_anchor.json"} <= names
    modes = {str(path): stat.S_IMODE(path.lstat().st_mode) for path in created}
    assert {path: oct(bits) for path, bits in modes.items() if bits & 0o077} == {}
    left = [path.name for path in (tmp_path / "t").iterdir() if path.name.startswith("dualbrain")]
    assert left == []  # onnxruntime leaves a file of its own there
