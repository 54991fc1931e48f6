"""Private files: modes with every umask, tightening of existing files, and no file that is created elsewhere."""

import ast
import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

import dualbrain
from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.core.storage.private_files import (
    create_private_folder,
    open_private,
    open_private_folder,
    private_file,
    private_folder,
    refuse_special_file,
    tighten,
)
from dualbrain.core.storage.resumable_steps import run_steps
from dualbrain.errors import ConfigurationError
from dualbrain.safety.integration.intervention_log import InterventionLog

CREATING_CALLS = {"write_text", "write_bytes", "mkdir", "touch", "copytree", "copyfile", "copy2", "atomic_file"}
CREATING_CALLS |= {"atomic_folder", "mkfifo", "NamedTemporaryFile", "makedirs"}
PUBLIC_PLACES = {
    "adaptation/adapters/registry.py": "copyfile into a private folder, whose files are then set to 0600",
    "adaptation/conversion/concatenated_lora.py": "writes into the folder of its caller, private or an export",
    "adaptation/conversion/gguf_lora.py": "an export; the copy in the cache is set to 0600 by gguf_cache",
    "adaptation/conversion/merged_gguf.py": "an export; the copy in the cache is set to 0600 by gguf_cache",
    "adaptation/training/model/dequantized_base.py": "weights of a public model",
    "cli/adapters/export.py": "an export for other programs",
    "cli/robot/commission.py": "a record at a path that the user names",
    "cli/robot/identify.py": "a record at a path that the user names",
    "core/storage/atomic_files.py": "the writer of exports",
    "core/storage/jsonl_log.py": "a private file, or an archive of an experiment for publication",
    "core/storage/private_files.py": "the place where private files are created",
    "core/storage/resumable_steps.py": "copies of private folders",
    "core/weights.py": "weights of public models",
    "evaluation/evidence/evidence_folder.py": "a folder for others, at a path that the user names",
    "evaluation/results/parquet.py": "a table for publication",
    "visualization/html/plot_style.py": "an image for publication",
    "evaluation/runner/run_ledgers.py": "copies of private folders",
    "memory/state/snapshot.py": "opens the temporary file of `private_file`",
    "robots/builtin/generate.py": "data of the package, for developers",
    "robots/importer/output/robot_folder.py": "a robot description at a path that the user names",
    "runtime/data_collection/lerobot/dataset_folder.py": "writes into the folder of its caller, an export",
    "runtime/data_collection/lerobot/export.py": "an export for other programs",
    "runtime/data_collection/lerobot/tables.py": "writes into the folder of its caller, an export",
    "simulation/models/collision_hulls.py": "data of the package, for developers",
    "visualization/evaluation/markdown_page.py": "a page for publication",
}
"""Modules that create files by other means, with the reason."""


@pytest.fixture(params=[0, 0o022, 0o777])
def umask(request) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.lstat().st_mode)


def test_new_files_and_folders_are_private(tmp_path, umask):
    create_private_folder(tmp_path / "a" / "b" / "c")
    for name in ("wb", "ab", "xb", "a+b"):
        with open_private(tmp_path / "a" / name, name) as file:
            file.write(b"x")
    with private_file(tmp_path / "a" / "atomic") as temporary:
        temporary.write_bytes(b"x")
    with private_file(tmp_path / "a" / "replaced") as temporary:
        temporary.unlink()
        temporary.write_bytes(b"x")
    with private_folder(tmp_path / "a" / "d" / "folder") as temporary:
        (temporary / "file").touch(mode=0o666)
        (temporary / "file").chmod(0o644)
    found = {path.relative_to(tmp_path).as_posix(): mode(path) for path in tmp_path.rglob("*")}
    folders = ("a", "a/b", "a/b/c", "a/d", "a/d/folder")
    assert {name: found[name] for name in folders} == dict.fromkeys(folders, 0o700)
    assert {name for name, bits in found.items() if bits & 0o077} == set()


@pytest.mark.parametrize("bits", [0o644, 0o666, 0o640, 0o604, 0o755])
def test_existing_files_are_tightened(tmp_path, bits):
    path = tmp_path / "file"
    for change in (tighten, lambda one: open_private(one, "ab").close(), lambda one: open_private(one, "wb").close()):
        path.touch()
        path.chmod(bits)
        change(path)
        assert mode(path) & 0o077 == 0
    tmp_path.chmod(0o755)
    create_private_folder(tmp_path)
    assert mode(tmp_path) == 0o755
    open_private_folder(tmp_path)
    assert mode(tmp_path) == 0o700


def test_links_shared_folders_and_files_of_others_are_not_changed(tmp_path, monkeypatch):
    target, link, shared = tmp_path / "target", tmp_path / "link", tmp_path / "shared"
    target.touch()
    target.chmod(0o644)
    link.symlink_to(target)
    shared.mkdir()
    shared.chmod(0o1777)
    os.mkfifo(tmp_path / "pipe", 0o644)
    for path in (link, shared, tmp_path / "pipe", tmp_path / "nothing"):
        tighten(path)
    assert (mode(target), mode(shared)) == (0o644, 0o1777)
    uid = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: uid + 1)
    tighten(target)
    open_private(target, "ab").close()
    assert mode(target) == 0o644


def test_a_special_file_is_refused_by_name(tmp_path):
    refuse_special_file(tmp_path / "nothing", "log")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ConfigurationError, match="The log is a named pipe and not a regular file"):
        refuse_special_file(tmp_path / "pipe", "log")


def test_a_folder_in_place_of_a_file_and_a_file_in_place_of_a_folder_are_errors(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError):
        create_private_folder(tmp_path / "file")
    with pytest.raises(OSError, match="directory"):
        open_private(tmp_path, "wb")


def test_logs_and_work_folders_are_private(tmp_path, umask):
    if umask == 0o777:
        pytest.skip("shutil.copytree needs permissions")
    JsonlLog(tmp_path / "log" / "work.jsonl").append({"key": 1})
    run_steps(tmp_path / "work", 2, lambda number, here: open_private(here / str(number), "wb").close())
    InterventionLog(tmp_path / "interventions.jsonl").close()
    assert {path for path in tmp_path.rglob("*") if mode(path) & 0o077} == set()


def test_every_other_module_creates_files_through_this_one():
    package = Path(dualbrain.__file__).parent
    found = set[str]()
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and _creates_a_file(node):
                found.add(path.relative_to(package).as_posix())
    assert found == set(PUBLIC_PLACES)


def _creates_a_file(call: ast.Call) -> bool:
    name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    if name in CREATING_CALLS:
        return True
    words = [one.value for one in call.args if isinstance(one, ast.Constant) and isinstance(one.value, str)]
    return name == "open" and any(set(word) <= set("wxab+rt") and set(word) & set("wxa") for word in words)
