"""Importing is light, rooms say what they are, help is quick."""

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
    "pint",
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
LIGHT_ROOMS = ("core", "contracts", "robots", "skills", "safety", "drivers")
ROOMS = tuple(part.name for part in pkgutil.iter_modules(dualbrain.__path__) if part.ispkg)


def loaded_by(statement):
    """Names of the modules that a fresh interpreter has loaded after `statement`."""
    code = f"import sys, json; {statement}; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(json.loads(done.stdout))


def modules(room):
    package = importlib.import_module(f"dualbrain.{room}")
    return [
        part.name
        for part in pkgutil.walk_packages(package.__path__, f"dualbrain.{room}.")
        if "__main__" not in part.name
    ]


def test_import_dualbrain_loads_nothing_heavy():
    assert not loaded_by("import dualbrain") & {*HEAVY, "numpy"}


@pytest.mark.parametrize("room", LIGHT_ROOMS)
def test_a_light_room_loads_nothing_heavy(room):
    names = [name for name in modules(room) if not name.rpartition(".")[2].startswith("_")]
    found = loaded_by("import " + ", ".join(names)) & set(HEAVY)
    if room == "robots":
        found -= {"matplotlib"}
    assert not found


def test_choosing_what_to_learn_needs_no_torch():
    names = [*modules("adaptation.curation"), *modules("adaptation.adapters"), "dualbrain.adaptation.config"]
    assert not loaded_by("import dualbrain.cli.adapters.adapt, " + ", ".join(names)) & {
        "torch",
        "transformers",
        "mujoco",
    }


@pytest.mark.parametrize("room", ROOMS)
def test_every_file_of_a_room_says_what_it_is(room):
    for name in [f"dualbrain.{room}", *modules(room)]:
        if not name.rpartition(".")[2].startswith("_kernel"):
            words = importlib.import_module(name).__doc__
            assert words, name
            assert words.strip(), name


def test_the_package_says_what_it_is():
    assert dualbrain.__doc__
    assert dualbrain.__version__


def test_help_takes_little_work():
    """Measured as processor time, because this machine may be busy; the best of three."""

    def cost():
        before = os.times()
        subprocess.run(
            [
                sys.executable,
                "-c",
                "import sys; from dualbrain.cli.main import run_command_line; sys.exit(run_command_line(['--help']))",
            ],
            capture_output=True,
            check=True,
        )
        after = os.times()
        return after.children_user + after.children_system - before.children_user - before.children_system

    assert min(cost() for _ in range(3)) < 0.5
