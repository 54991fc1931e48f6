"""Checks of the connector in rollouts of the installed inspect-robots; the first failure ends it.

Run by `test_package.py`: python check_package.py FOLDER
"""

import dataclasses
import importlib
import importlib.util
import inspect
import sys
from pathlib import Path

import numpy as np
from inspect_robots import Scene, Task, eval
from inspect_robots.approver import ChainApprover, ClampApprover
from inspect_robots.cli import _build_guardrails
from inspect_robots.conformance import assert_guardrail_contribution_conformant
from inspect_robots.policy import PolicyConfig, PolicyInfo
from inspect_robots.registry import embodiment, policy, resolve
from inspect_robots.scorer import episode_length
from inspect_robots.types import Action, ActionChunk
from inspect_robots_dualbrain import GuardedEmbodiment
from inspect_robots_dualbrain.connector import check

from dualbrain import HalfSpace, Obstacle, SafetyFilter
from dualbrain.core.connectors import installed_connectors
from tests.integrations.inspect_robots.arm_embodiment import HOME, OPEN, PANDA, ArmEmbodiment

STAND_IN = Path(__file__).resolve().parent / "stand_in" / "inspect_robots"
LOW = HOME + np.array([0.0, 1.5, 0.0, 0.9, 0.0, 0.0, 0.0])


def show(*values):
    """Write a line."""
    sys.stdout.write(" ".join(map(str, values)) + "\n")


class TablePolicy:
    """Commands a position with the hand below the table, in chunks, and keeps the reviews that it receives."""

    def __init__(self, values=LOW):
        arm = ArmEmbodiment()
        self.values = values
        self.info = PolicyInfo(name="table", action_space=arm.info.action_space)
        self.config = PolicyConfig(action_horizon=4)
        self.reviews = []

    def reset(self, scene):
        del scene

    def act(self, observation):
        self.reviews.append(observation.extra.get("dualbrain"))
        return ActionChunk([Action(data=np.append(self.values, OPEN)) for _ in range(4)])


def run(arm, *, approver, values=LOW, folder, steps=80):
    """The log of one episode of the table policy, and the policy."""
    table = TablePolicy(values)
    task = Task(name="table", scenes=[Scene(id="a", instruction="reach")], scorer=episode_length(), max_steps=steps)
    (log,) = eval(task, table, arm, log_dir=str(folder), approver=approver)
    return log, table


def clearance(path):
    """The smallest barrier value [m] of the arm above the table."""
    safety = SafetyFilter(PANDA, obstacles=[Obstacle("table", HalfSpace())])
    found = []
    for q in path:
        safety.reset()
        found.append(safety(q, np.zeros(7), np.zeros(7), 0.0).h_min)
    return min(found)


def check_stand_in():
    """Every record, error and method of the stand-in has the fields and parameters of the package."""
    compared = 0
    for file in sorted(STAND_IN.glob("[a-z]*.py")):
        spec = importlib.util.spec_from_file_location(f"stand_in_{file.stem}", file)
        stand_in = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = stand_in
        spec.loader.exec_module(stand_in)
        real = importlib.import_module(f"inspect_robots.{file.stem}")
        for name, own in vars(stand_in).items():
            if getattr(own, "__module__", "") != spec.name or name.startswith("_"):
                continue
            there = getattr(real, name)
            if dataclasses.is_dataclass(own):
                described = [[(one.name, one.default) for one in dataclasses.fields(cls)] for cls in (own, there)]
                assert [one[0] for one in described[0]] == [one[0] for one in described[1]], name
            for method in ("review", "reset", "step", "close", "rewind_reference"):
                if hasattr(own, method):
                    names = [list(inspect.signature(getattr(cls, method)).parameters) for cls in (own, there)]
                    assert names[0] == names[1], (name, method, names)
            if inspect.isfunction(own):
                assert callable(there)
            compared += 1
    assert compared > 15


def check_guarded(folder):
    """Behind the guardrails of the command line the arm keeps clear of the table, and the policy reads why."""
    bare = ArmEmbodiment()
    run(bare, approver=None, folder=folder)
    assert clearance(bare.path) < -0.1
    inner = ArmEmbodiment()
    guarded = GuardedEmbodiment(inner, PANDA)
    assert_guardrail_contribution_conformant(guarded, guarded.info.action_space)
    approver, active, warnings = _build_guardrails(guarded.info.action_space, None, guarded)
    assert (active, warnings) == (["clamp", "delta-limit", "dualbrain"], [])
    log, table = run(guarded, approver=approver, folder=folder)
    assert log.status == "success"
    assert clearance(inner.path) > 0.0
    show("least clearance without and with the approver [m]:", clearance(bare.path), clearance(inner.path))
    show("first review:", table.reviews[1])
    show("last review: ", table.reviews[-1])
    assert table.reviews[1]["limit"] == "speed"
    assert (table.reviews[-1]["limit"], table.reviews[-1]["verdict"]) == ("contact", "modified")


def check_halts(folder):
    """A missing approver, an approver before others, and a faulty state halt the evaluation."""
    log, _ = run(GuardedEmbodiment(ArmEmbodiment(), PANDA), approver=None, folder=folder)
    assert log.status == "error"
    assert "approver=embodiment.approver" in str(log.error)
    guarded = GuardedEmbodiment(ArmEmbodiment(), PANDA)
    narrow = dataclasses.replace(guarded.info.action_space, low=np.full(8, -0.1), high=np.full(8, 0.1))
    early = ChainApprover(guarded.approver, ClampApprover(narrow))
    log, _ = run(guarded, approver=early, folder=folder)
    assert "executes only the action that its approver returned last" in str(log.error)

    class Failing(ArmEmbodiment):
        def observation(self, **changes):
            return super().observation(**({"state": {}} if self.time > 1.0 else {}), **changes)

    inner = Failing()
    guarded = GuardedEmbodiment(inner, PANDA)
    log, _ = run(guarded, approver=guarded.approver, folder=folder)
    assert log.status == "error"
    assert "has no state 'joint_pos'" in str(log.error)
    assert np.abs(inner.v).max() < 1e-6
    show("halt:", log.error)


def check_registration(folder):
    """The registered embodiment runs by name, and `dualbrain doctor` finds the connector without a problem."""
    embodiment("check_arm")(ArmEmbodiment)
    policy("table")(TablePolicy)
    guarded = resolve("embodiment", "dualbrain_guarded", inner="check_arm", guard_model="panda")
    log, table = run(guarded, approver=guarded.approver, folder=folder)
    assert log.status == "success"
    assert table.reviews[-1]["limit"] == "contact"
    assert check() == []
    (state,) = [state for state in installed_connectors() if state.name == "inspect_robots"]
    assert state.problems == ()
    show("doctor:", state.text)


if __name__ == "__main__":
    check_stand_in()
    for checked in (check_guarded, check_halts, check_registration):
        checked(Path(sys.argv[1]))
    show("checked")
