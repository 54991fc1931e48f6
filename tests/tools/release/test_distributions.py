"""A source distribution has no results and no images, and each interpreter gets the wheel that pip selects."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from pathspec import GitIgnoreSpec

from tools.release.distribution_checks import REQUIRED_FILES, sdist_problems
from tools.release.distributions import find_distributions, zig_options, zig_settings
from tools.release.environments import ROOT, Environment


def test_the_exclusions_of_pyproject_leave_nothing_that_is_refused():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["scikit-build"]
    excluded = GitIgnoreSpec.from_lines(settings["sdist"]["exclude"])
    names = [name for name in listed.stdout.splitlines() if not excluded.match_file(name)]
    assert sdist_problems(names) == []
    assert {name.partition("/")[0] for name in names} >= {"src", "kernel", "firmware", "tests", "examples", "vectors"}


@pytest.mark.parametrize(
    "name",
    [
        "docs/results/paper/results.parquet",
        "docs/images/demo.png",
        "docs/explanation/new.svg",
        "experiments/logs/faults.jsonl.xz",
        ".ci/run",
        "build/site/index.html",
        "src/dualbrain/safety/cbf/compiled/_kernel.so",
    ],
)
def test_a_file_that_does_not_belong_there_is_a_problem(name):
    (problem,) = sdist_problems([*REQUIRED_FILES, name])
    assert name in problem


def test_a_missing_file_is_a_problem():
    assert sdist_problems(REQUIRED_FILES[1:]) == [f"{REQUIRED_FILES[0]} is missing"]
    assert sdist_problems([*REQUIRED_FILES, "src/dualbrain/memory/data/filter.png"]) == []


def test_python_311_gets_the_gcc_wheel_and_newer_ones_that_of_the_stable_abi(tmp_path):
    names = ("x-1.tar.gz", "x-1-cp311-cp311-manylinux_2_34_x86_64.whl", "x-1-cp312-abi3-manylinux_2_17_x86_64.whl")
    for name in names:
        (tmp_path / name).touch()
    found = find_distributions(tmp_path)
    assert [path.name for path in found.files] == list(names)
    assert [found.wheel_for(version).name for version in ("3.11", "3.12", "3.13")] == [names[1], names[2], names[2]]
    (tmp_path / names[2]).unlink()
    with pytest.raises(FileNotFoundError, match=r"no wheel for Python 3\.13"):
        find_distributions(tmp_path).wheel_for("3.13")


def test_each_tool_of_zig_is_one_program_for_the_old_c_library(tmp_path):
    build = Environment(tmp_path / "environment")
    build.python.parent.mkdir(parents=True)
    build.python.write_text('#!/bin/sh\necho "$@"\n')
    build.python.chmod(0o755)
    settings = zig_settings(tmp_path, build)
    printed = {
        name: subprocess.check_output([settings[name], "a b"], text=True) for name in ("CC", "CXX", "AR", "RANLIB")
    }
    assert printed["CC"].startswith("-m ziglang cc -target ")
    assert printed["CXX"].startswith("-m ziglang c++ -target ")
    assert "linux-gnu.2.17 a b" in printed["CC"]
    assert (printed["AR"], printed["RANLIB"]) == ("-m ziglang ar a b\n", "-m ziglang ranlib a b\n")
    assert all(
        Path(option.partition("=")[2].partition("=")[2] or sys.executable).exists()
        for option in zig_options(tmp_path)[1:]
    )


def test_the_binding_uses_no_macro_outside_the_limited_api_of_python():
    sources = [path for path in (ROOT / "kernel").rglob("*") if path.suffix in (".cpp", ".h")]
    macros = re.compile(r"\bPy(?!Array)[A-Za-z]*_(?:AS|GET|SET)_[A-Z_]+\(")  # those of NumPy are in its own tables
    assert len(sources) > 10
    assert {path.name: found for path in sources if (found := macros.findall(path.read_text("utf-8")))} == {}
