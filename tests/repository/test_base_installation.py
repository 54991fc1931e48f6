"""The base installation is dualbrain and four packages: the library works, and the program names the missing extra."""

import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.core.lazy_exports import EXTRAS

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
BLOCKER = """
import sys
from importlib.abc import MetaPathFinder
ALLOWED = {*sys.stdlib_module_names, "dualbrain", "numpy", "msgspec", "jsonschema_rs", "filelock", "_virtualenv"}

class Blocked(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in ALLOWED:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocked())
"""
"""Hides every package that the base installation does not contain."""


def run_base(code, *arguments):
    """The finished process of a program in a simulated base installation."""
    program = [sys.executable, "-c", BLOCKER + code, *arguments]
    return subprocess.run(program, capture_output=True, text=True, timeout=60, check=False)


def required(name):
    """Distributions that `name` needs without an extra, on this Python."""
    return [line for line in metadata.requires(name) or [] if "extra ==" not in line and "python_version <" not in line]


def test_it_has_at_most_five_packages_and_none_brings_another():
    names = [re.split(r"[<>=]", line)[0] for line in PROJECT["dependencies"]]
    assert len(names) <= 5
    assert [required(name) for name in names] == [[]] * len(names)


NAMES_MISSING = """
import importlib, sys
from dualbrain.errors import MissingDependencyError
module = importlib.import_module(sys.argv[1])
for name in module.__all__:
    try:
        getattr(module, name)
    except MissingDependencyError as error:
        print(name, error)
"""
"""Prints the public names that need another package, with the error."""


@pytest.mark.parametrize(
    ("namespace", "needing_extras"),
    [
        ("dualbrain.safety", {"FilteredEnv"}),
        ("dualbrain.safety.barriers", set()),
        ("dualbrain.safety.higher_order", set()),
        ("dualbrain.skills", set()),
        ("dualbrain", {"CellOptions", "FilteredEnv", "Robot", "SimulatedCell", "open_planner", "run"}),
    ],
)
def test_every_public_name_works_or_names_its_extra(namespace, needing_extras):
    done = run_base(NAMES_MISSING, namespace)
    assert (done.returncode, done.stderr) == (0, "")
    missing = dict(line.split(" ", 1) for line in done.stdout.splitlines())
    assert missing.keys() == needing_extras
    assert all("pip install 'dualbrain[" in message for message in missing.values())


@pytest.mark.parametrize("package", ["contracts", "robots"])
def test_the_modules_of_contracts_and_robots_are_importable(package):
    code = f"""
import importlib, pkgutil, dualbrain.{package} as package
for part in pkgutil.iter_modules(package.__path__):
    importlib.import_module(f"{{package.__name__}}.{{part.name}}")
"""
    assert run_base(code).stderr == ""


@pytest.mark.parametrize("example", ["01_gate_a_contract", "02_filter_five_lines"])
def test_the_examples_of_gate_and_filter_run(example):
    done = run_base(
        "import runpy; runpy.run_path(sys.argv[1], run_name='__main__')", str(ROOT / "examples" / f"{example}.py")
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout


def test_the_program_prints_its_version():
    done = run_base("from dualbrain.__main__ import run_program; sys.exit(run_program(['--version']))")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"{metadata.version('dualbrain')}\n", "")


@pytest.mark.parametrize("arguments", [["doctor"], ["--help"], []], ids=["doctor", "help", "none"])
def test_the_program_without_its_extra_is_one_line(arguments):
    code = "from dualbrain.__main__ import run_program; sys.exit(run_program(sys.argv[1:]))"
    done = run_base(code, *arguments)
    assert (done.returncode, done.stdout) == (ExitCode.USAGE, "")
    (line,) = done.stderr.splitlines()
    assert "pip install 'dualbrain[cli]'" in line


def test_every_extra_with_commands_brings_the_command_line():
    extras = PROJECT["optional-dependencies"]
    library = {"cli", "gym", "symbolic", "docs", "release", "dev"}  # no command needs these

    def packages(extra):
        for line in extras[extra]:
            own = re.fullmatch(r"dualbrain\[(.*)\]", line)
            yield from (name for part in own[1].split(",") for name in packages(part)) if own else [line]

    assert {name for name in extras if "cyclopts>=5" not in packages(name)} == library - {"cli", "dev"}
    assert {"cyclopts", "rich"} == {module for module, extra in EXTRAS.items() if extra == "cli"}
