"""All discovered barriers: under a strong push h stays at or above zero, and it does not without the filter."""

import importlib
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dualbrain.safety.barriers import BARRIERS
from dualbrain.safety.barriers.__main__ import render_markdown
from dualbrain.safety.barriers.barrier import BarrierSpec
from dualbrain.safety.barriers.scenarios import EXACT_TRACKING, integrate, sparse_panda, sparse_panda_filter
from dualbrain.safety.barriers.singularity import SINGULAR_POSTURE, SingularityBarrier, min_singular_value
from dualbrain.safety.cbf.filter import FilterStatus, SafetyFilter

PACKAGE = Path(__file__).resolve().parents[2] / "src" / "dualbrain" / "safety" / "barriers"
NAMES = sorted(BARRIERS)
BARRIER_OF_ROWS = {"contact": "obstacle"}
"""Barriers whose rows have another name: contact rows replace rows of an obstacle."""


def run_scenario(scenario, *, filtered=True):
    """h in every step of the scenario, the barriers named by the results, and the statuses."""
    q, rest = scenario.start.copy(), np.zeros(scenario.safety.robot_model.n)
    values, named, statuses = [], set(), set()
    for _ in range(int(scenario.duration / scenario.safety.robot_model.period)):
        u = np.asarray(scenario.nominal(q), float)
        if filtered:
            answer = scenario.safety(q, rest, u)
            u = answer.u
            named.update(answer.barriers)
            statuses.add(answer.status)
        values.append(scenario.h(q, u))
        q = integrate(scenario.safety.robot_model, q, u)
    return np.array(values), named, statuses


def test_every_module_of_the_package_defines_exactly_one_barrier():
    stems = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__", "__main__", "barrier", "scenarios"}
    defined = {}
    for stem in sorted(stems):
        module = importlib.import_module(f"dualbrain.safety.barriers.{stem}")
        defined[stem] = [value for value in vars(module).values() if isinstance(value, BarrierSpec)]
    assert {stem: len(specs) for stem, specs in defined.items()} == dict.fromkeys(stems, 1)
    specs = [spec for (spec,) in defined.values()]
    names = [spec.name for spec in specs]
    assert len(set(names)) == len(names)
    assert {spec.name: spec for spec in specs} == BARRIERS


@pytest.mark.parametrize("name", NAMES)
def test_it_holds_and_is_named(name):
    h, named, statuses = run_scenario(BARRIERS[name].scenario())
    assert h.min() >= 0.0
    assert BARRIER_OF_ROWS.get(name, name) in named
    assert statuses <= {FilterStatus.SAFE, FilterStatus.MODIFIED}


@pytest.mark.parametrize("name", NAMES)
def test_without_the_filter_it_would_break(name):
    h, _, _ = run_scenario(BARRIERS[name].scenario(), filtered=False)
    assert h.min() < -0.01


# --- singular postures: slower, never stopped ---------------------------------------------------------------------


def singular_value(safety, q):
    return min_singular_value(safety.tool(q).jacobian, 0.3)[0]


def test_the_gradient_of_the_singular_value_is_its_derivative(panda):
    safety = SafetyFilter(panda, msgspec.structs.replace(EXACT_TRACKING, precision="float64"))
    rng = np.random.default_rng(3)
    for _ in range(20):
        q = np.array(panda.home) + rng.uniform(-0.5, 0.5, 7)
        gradient = min_singular_value(safety.tool(q).jacobian, 0.3)[1]
        steps = 1e-5 * np.eye(7)
        measured = [(singular_value(safety, q + d) - singular_value(safety, q - d)) / 2e-5 for d in steps]
        np.testing.assert_allclose(gradient, measured, atol=2e-4)


def path(seed):
    """Start and end of a path from a random posture through a singular one."""
    rng = np.random.default_rng(seed)
    joints = sparse_panda().joints
    low, high = (np.array([getattr(joint, side).value for joint in joints]) for side in ("lower", "upper"))
    through = SINGULAR_POSTURE + np.array(
        [rng.uniform(-1, 1), 0.0, 0.0, rng.uniform(-0.5, 0.3), 0.0, rng.uniform(-0.5, 0.5), rng.uniform(-1, 1)]
    )
    away = rng.uniform(-0.4, 0.4, 7)
    return np.clip(through - away, low + 0.1, high - 0.1), np.clip(through + away, low + 0.1, high - 0.1)


def along_the_path(safety, seed, seconds=20.0):
    """Whether a joint-space controller arrives at the end of the path, and the statuses on the way."""
    start, end = path(seed)
    q, statuses = start.copy(), set()
    for _ in range(int(seconds / safety.robot_model.period)):
        answer = safety(q, np.zeros(7), 2.0 * (end - q))
        statuses.add(answer.status)
        q = q + safety.robot_model.period * answer.u
        if np.max(np.abs(end - q)) < 0.01:
            return True, statuses
    return False, statuses


def test_the_paths_pass_through_singular_postures():
    safety = sparse_panda_filter()
    for seed in range(50):
        start, end = path(seed)
        assert min(singular_value(safety, start + t * (end - start)) for t in np.linspace(0, 1, 101)) < 0.02


@pytest.mark.parametrize("seed", [0, 1, pytest.param("all", marks=pytest.mark.slow)])
def test_paths_through_singular_postures_complete(seed):
    """Two of fifty paths with seeds; all of them with the marker `slow`."""
    safety = sparse_panda_filter(barriers=(SingularityBarrier(sparse_panda().alpha),))
    for one in range(50) if seed == "all" else (seed,):
        safety.reset()
        arrived, statuses = along_the_path(safety, one)
        assert arrived, f"path {one}"
        assert statuses <= {FilterStatus.SAFE, FilterStatus.MODIFIED}


def test_it_slows_near_the_singular_posture():
    """Near the singular posture σ falls no faster than the barrier allows, and at most half as fast as without it."""
    fastest = {}
    for barriers in ((), (SingularityBarrier(sparse_panda().alpha),)):
        safety = sparse_panda_filter(barriers=barriers)
        q, seen = SINGULAR_POSTURE + np.array([0.0, 0.25, -0.25, 0.0, 0.2, 0.0, 0.0]), []
        for _ in range(1500):
            answer = safety(
                q, np.zeros(7), 1.5 * np.sign(SINGULAR_POSTURE - q) * np.minimum(np.abs(SINGULAR_POSTURE - q) * 5, 0.5)
            )
            if singular_value(safety, q) < 0.06:
                _, gradient = min_singular_value(safety.tool(q).jacobian, 0.3)
                seen.append(-float(gradient @ answer.u))
            q = q + 1e-3 * answer.u
        fastest[bool(barriers)] = max(seen)
    assert fastest[True] <= 0.5 * fastest[False]
    assert fastest[True] <= max(sparse_panda().alpha * 0.03, 0.02) + 5e-3


def test_the_page_documents_every_barrier_and_is_up_to_date():
    page = "docs/reference/safety/barriers.md"
    stored = (Path(__file__).resolve().parents[2] / page).read_text()
    assert re.findall(r"^## (\w+)$", stored, re.MULTILINE) == list(BARRIERS)
    assert stored == render_markdown(), f"regenerate the page: python -m dualbrain.safety.barriers > {page}"


@pytest.mark.parametrize("name", NAMES)
def test_the_files_of_the_implementation_exist(name):
    root = Path(__file__).resolve().parents[2]
    for path in re.findall(r"[\w/]+\.(?:py|c)\b", BARRIERS[name].implementation):
        assert (root / path).is_file() or (root / "src" / "dualbrain" / path).is_file(), path
