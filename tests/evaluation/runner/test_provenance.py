import re
import subprocess
import sys
from pathlib import Path

import dualbrain
from dualbrain.evaluation.runner.provenance import REPORTING, git_revision


def test_the_revision_is_that_of_the_checkout_that_tracks_the_code(tmp_path):
    package, installed = tmp_path / "package", tmp_path / "site"
    for folder in (package, installed):
        folder.mkdir()
        (folder / "__init__.py").write_text("")
    assert git_revision(package) == "no checkout"
    git = ["git", "-C", str(tmp_path), "-c", "user.name=n", "-c", "user.email=e"]
    for words in (["init", "-q"], ["add", "package"], ["commit", "-qm", "one"]):
        subprocess.run([*git, *words], check=True)
    head = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout
    assert git_revision(package) == head[:12]
    (package / "__init__.py").write_text("changed")
    changed = git_revision(package)
    assert re.fullmatch(rf"{head[:12]}\+[0-9a-f]{{6}}", changed)
    assert git_revision(package, ["package"]) == changed
    assert git_revision(package, ["elsewhere"]) == head[:12]
    (package / "__init__.py").write_text("changed again")
    assert git_revision(package) not in (changed, head[:12])
    assert git_revision(installed) == "no checkout"  # it is in the folder, but not tracked


def test_workers_do_not_load_reporting_code():
    """The code that the provenance hash leaves out is not even loaded by a worker."""
    listed = subprocess.run(
        [sys.executable, "-c", "import dualbrain.evaluation.runner.worker, sys; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    loaded = listed.stdout.split()
    assert "dualbrain.evaluation.episodes.scoring" in loaded
    package = Path(dualbrain.__file__).parent
    for part in REPORTING:
        module = "dualbrain." + part.removesuffix(".py").replace("/", ".")
        assert (package / part).exists()
        assert not [name for name in loaded if name == module or name.startswith(f"{module}.")]
