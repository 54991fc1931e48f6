"""Connectors of other packages: announced by entry point, checked, and reported if they cannot be loaded."""

import sys

import pytest

from dualbrain.cli import doctor
from dualbrain.core.connectors import installed_connectors

MODULE = """
from dualbrain import Connector

def announce(check, framework="numpy"):
    return Connector(name="some framework", description="Filters its actions.", version="1.2",
                     framework=framework, framework_version="0.1", check=check)

def fail():
    raise OSError("the bus is gone")

working = announce(lambda: ())
function = lambda: working
absent = announce(lambda: ["No robot is registered. Remedy: install it again."], "no-such-framework")
failing = announce(fail)
text = announce(lambda: "one problem")
nothing = announce(lambda: None)
nameless = announce(lambda: (), None)
number = 7

def leave():
    raise SystemExit("this package ends the program")
"""
NAMES = ("working", "function", "absent", "failing", "text", "nothing", "nameless", "number", "leave")
ENTRIES = "[dualbrain.integrations]\n" + "".join(f"{name} = some_connectors:{name}\n" for name in NAMES)
BROKEN = """
gone = some_connectors:no_such_name
missing = no_such_module:connector
"""


@pytest.fixture
def states(tmp_path, monkeypatch):
    """The states of the connectors of an installed package, by the name of their entry points."""
    (tmp_path / "some_connectors.py").write_text(MODULE)
    folder = tmp_path / "some_connectors-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: some-connectors\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(ENTRIES + BROKEN)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield {state.name: state for state in installed_connectors() if state.distribution == "some-connectors"}
    sys.modules.pop("some_connectors", None)


def test_every_entry_is_listed(states):
    assert set(states) == {*NAMES, "gone", "missing"}


@pytest.mark.parametrize("name", ["working", "function"])
def test_a_connector_that_works_has_no_problem_and_states_both_versions(states, name):
    assert states[name].problems == ()
    text = states[name].text
    assert text.startswith("some framework 1.2: Filters its actions. (built against numpy 0.1, installed: ")


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("absent", "No robot is registered"),
        ("failing", "the check of some framework failed: OSError: the bus is gone"),
        ("text", "one problem"),
        ("nothing", "the check of some framework failed: TypeError"),
        ("nameless", "cannot be loaded (ValueError"),
        ("number", "got 'int', allowed: a Connector"),
        ("leave", "SystemExit: this package ends the program"),
        ("gone", "cannot be loaded (AttributeError"),
        ("missing", "cannot be loaded (ModuleNotFoundError: No module named 'no_such_module')"),
    ],
)
def test_a_connector_that_does_not_work_is_reported_with_its_cause(states, name, problem):
    (found,) = states[name].problems
    assert problem in found


def test_a_framework_that_is_not_installed_is_named(states):
    assert "no-such-framework 0.1, installed: not installed" in states["absent"].text


def test_doctor_lists_every_connector(states):
    found = {one.item: one for one in doctor._connectors()}
    assert {f"connector {name}" for name in states} <= set(found)
    assert found["connector working"].state == "ok"
    assert found["connector missing"].state == "problem"
    assert found["connector missing"].text.startswith("some-connectors: no_such_module:connector cannot be loaded")
