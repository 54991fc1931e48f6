"""Imports are light, every module has a docstring, and the help is fast."""

import importlib
import json
import os
import pkgutil
import subprocess
import sys

import pytest

import dualbrain

HEAVY = (
    "torch",
    "transformers",
    "mujoco",
    "matplotlib",
    "viser",
    "onnxruntime",
    "xllamacpp",
    "rich",
    "cyclopts",
    "pylibfranka",
    "rtde_control",
    "rtde_receive",
)
LIGHT_PACKAGES = ("core", "contracts", "robots", "skills", "safety", "drivers")
PACKAGES = tuple(part.name for part in pkgutil.iter_modules(dualbrain.__path__) if part.ispkg)


def loaded_by(statement):
    """Names of the modules that a fresh interpreter has loaded after `statement`."""
    code = f"import sys, json; {statement}; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout))


def modules(name):
    """Names of all modules of the package `dualbrain.NAME`."""
    package = importlib.import_module(f"dualbrain.{name}")
    return [
        part.name
        for part in pkgutil.walk_packages(package.__path__, f"dualbrain.{name}.")
        if "__main__" not in part.name
    ]


def test_import_dualbrain_loads_nothing_heavy():
    assert not loaded_by("import dualbrain") & {*HEAVY, "numpy"}


@pytest.mark.parametrize("package", LIGHT_PACKAGES)
def test_a_light_package_loads_nothing_heavy(package):
    names = [name for name in modules(package) if not name.rpartition(".")[2].startswith("_")]
    found = loaded_by("import " + ", ".join(names)) & set(HEAVY)
    if package == "robots":
        found -= {"matplotlib"}
    assert not found


def test_curation_of_training_data_needs_no_torch():
    names = [*modules("adaptation.curation"), *modules("adaptation.adapters"), "dualbrain.adaptation.config"]
    assert not loaded_by("import dualbrain.cli.adapters.adapt, " + ", ".join(names)) & {
        "torch",
        "transformers",
        "mujoco",
    }


@pytest.mark.parametrize("package", PACKAGES)
def test_every_module_has_a_docstring(package):
    for name in [f"dualbrain.{package}", *modules(package)]:
        if not name.rpartition(".")[2].startswith("_kernel"):
            docstring = importlib.import_module(name).__doc__
            assert docstring, name
            assert docstring.strip(), name


def test_the_package_has_a_docstring_and_a_version():
    assert dualbrain.__doc__
    assert dualbrain.__version__


def processor_time(program):
    """Processor time [s] of a Python program in a process of its own."""
    before = os.times()
    subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def test_help_takes_little_processor_time():
    """Against the import of the libraries of the command line; the best of five, because the machine may be busy."""
    shown = "import sys; from dualbrain.cli.main import run_command_line; sys.exit(run_command_line(['--help']))"
    pairs = [(processor_time(shown), processor_time("import cyclopts, rich.console, msgspec")) for _ in range(5)]
    assert min(cost for cost, _ in pairs) < 3.0 * min(peer for _, peer in pairs)
