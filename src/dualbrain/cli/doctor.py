"""dualbrain doctor: what is here, what is missing, and how to get it."""

from __future__ import annotations

import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from dualbrain import __version__
from dualbrain.cli.common.console import print_table
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.graphics import choose_graphics
from dualbrain.cli.common.paths import cache_folder, dualbrain_home
from dualbrain.core import weights
from dualbrain.errors import DualbrainError


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the examination: `good` False means something is missing, and `text` says how to get it."""

    item: str
    ok: bool
    text: str


def doctor(*, robot: str = "") -> int:
    """Examine this installation: versions, kernel, rendering, models, memory, latency of one filter step.

    Parameters
    ----------
    robot
        Examine this robot instead: a known name, or a folder that `dualbrain robot init` made.
    """
    if robot:
        return _print_findings(_robot(robot))
    examinations = (_versions, _kernel, _latency, _rendering, _models, _memory)
    return _print_findings([finding for examine in examinations for finding in _run_examination(examine)])


def _print_findings(findings: list[Finding]) -> int:
    rows = [("ok" if finding.ok else "--", finding.item, finding.text) for finding in findings]
    print_table(("", "what", "found"), rows, wrap_columns=("found",))
    return ExitCode.SUCCESS if all(finding.ok for finding in findings) else ExitCode.SETUP


def _robot(robot: str) -> list[Finding]:
    """What is missing of one robot; whether the kernel has room for it."""
    from dualbrain.robots.importer.output.markdown import missing_information
    from dualbrain.robots.importer.output.robot_folder import read_import_files
    from dualbrain.robots.loader import load_robot
    from dualbrain.safety.cbf.filter import SafetyFilter

    robot_model, folder = load_robot(robot), Path(robot)
    SafetyFilter(robot_model)
    report, _ = read_import_files(folder) if folder.is_dir() else (None, None)
    found = f"{robot_model.n} joints, {len(robot_model.spheres)} spheres, every bound with its provenance"
    return [
        Finding(robot_model.name, True, found),
        *(Finding("missing", False, line) for line in missing_information(robot_model, report)),
    ]


def _run_examination(examine: Callable[[], list[Finding]]) -> list[Finding]:
    try:
        return examine()
    except (DualbrainError, ImportError, OSError) as error:
        return [Finding(examine.__name__.strip("_"), False, str(error))]


def _versions() -> list[Finding]:
    parts = ("numpy", "mujoco", "msgspec", "jsonschema-rs", "xllamacpp", "onnxruntime", "mcap", "viser")
    found = ", ".join(f"{part} {_version(part)}" for part in parts)
    return [
        Finding("dualbrain", True, f"{__version__} on Python {platform.python_version()}"),
        Finding("packages", "not" not in found, found),
    ]


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "not installed (pip install 'dualbrain[all]')"


def _kernel() -> list[Finding]:
    from dualbrain.safety.cbf.kernel import kernel_hash

    return [Finding("kernel", True, f"float32, C99, source hash {kernel_hash()}")]


def _latency() -> list[Finding]:
    from dualbrain.grounding.offline_gate import scene_from_spec
    from dualbrain.robots.interface import home_state
    from dualbrain.robots.loader import load_robot
    from dualbrain.safety.cbf.filter import SafetyFilter
    from dualbrain.safety.cbf.obstacles import obstacles_from_scene
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    robot_model = load_robot("panda")
    safety, state = SafetyFilter(robot_model), home_state(robot_model)
    safety.observe(obstacles_from_scene(scene_from_spec(open_scene("0")), known=(), held=None), 0.0)
    times: list[float] = []
    for _ in range(2000):
        start = time.perf_counter()
        safety.filter(state, state.v, 0.0)
        times.append((time.perf_counter() - start) * 1e6)
    tracking = robot_model.tracking
    lag = f"lag {tracking.lag * 1e3:.2f} ms, rows keep {tracking.row_margin(robot_model.alpha):.4f} rad/s"
    return [
        Finding("filter step", True, f"{statistics.median(times):.1f} µs median, scene 0, from Python"),
        Finding("tracking model", True, f"{robot_model.name}: {lag} ({tracking.provenance})"),
    ]


def _rendering() -> list[Finding]:
    why = choose_graphics(os.environ)
    from dualbrain.robots.loader import load_robot
    from dualbrain.simulation.perception.rendering import INSTALL_HINT, Camera
    from dualbrain.simulation.plant.plant import Plant
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    if why:
        return [Finding("rendering", False, f"{why}. {INSTALL_HINT}")]
    with Camera(Plant(open_scene("bare:0"), load_robot("panda")), width=64, height=48) as camera:
        picture = camera.capture()
    return [Finding("rendering", bool(picture.any()), f"MUJOCO_GL={os.environ['MUJOCO_GL']}")]


def _models() -> list[Finding]:
    def one(status: weights.WeightStatus) -> Finding:
        good = status.verified
        return Finding(
            status.file.name, good, "verified" if good else f"not here: dualbrain models fetch {status.file.name}"
        )

    return [one(status) for status in weights.list_weights(cache_folder())]


def _memory() -> list[Finding]:
    from dualbrain.memory.ledger.ledger import LedgerReader

    path: Path = dualbrain_home() / "ledger.sqlite"
    if not path.exists():
        return [Finding("memory", True, "empty: no run yet")]
    with LedgerReader(path) as ledger:
        report = ledger.verify()
    state = "chain whole" if report.is_intact else f"damaged at event {report.broken_at}: {report.fault}"
    return [Finding("memory", report.is_intact, f"{report.events} events, {state}")]
