"""dualbrain doctor: check the installation, and list install commands for missing parts."""

from __future__ import annotations

import os
import platform
import shutil
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from dualbrain import __version__
from dualbrain.cli.common.console import print_table
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.graphics import choose_graphics
from dualbrain.core import weights
from dualbrain.core.paths import cache_folder, dualbrain_home
from dualbrain.errors import DualbrainError

State = Literal["ok", "optional", "problem"]
OPTIONAL_PACKAGES = (
    ("simulation", "mujoco"),
    ("planner", "xllamacpp"),
    ("memory", "onnxruntime"),
    ("knowledge", "pypdf"),
    ("view", "viser"),
    ("mcp", "mcp"),
    ("import", "yourdfpy"),
    ("evaluation", "arro3-io"),
    ("adapt", "torch"),
)
"""Each extra with the package that shows whether it is installed."""
RUN_PACKAGES = ("mujoco", "onnxruntime", "tokenizers")
"""Packages without which `dualbrain run` ends before it opens a model file."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report: "optional" means not installed and not required, "problem" gives the remedy."""

    item: str
    state: State
    text: str


def doctor(*, robot: str = "", target: str = "") -> int:
    """Check this installation: versions, kernel, filter latency, rendering, targets, planners, model files, memory.

    Lists every installed connector of another framework with the problems that its check finds, and every running
    gatekeeper of this user: process, robot, socket, start, what started it, whether a commander is connected, and how
    to end it.

    Exit code 0 unless a line has the state "problem". Optional parts that are not installed are not problems. The text
    encoder is not optional where the extras of `dualbrain run` are installed.

    Parameters
    ----------
    robot
        Check this robot model instead: a name, or a folder made by `dualbrain robot init`.
    target
        Check this emulated board instead (an386, an500, an505): build the firmware of the robot (default panda), start
        it, and compare the hash of the kernel that it states with the kernel of this computer.
    """
    if target:
        return _print_findings(_run_check(partial(_target, target, robot or "panda"), f"target {target}"))
    if robot:
        return _print_findings(_robot(robot))
    checks = {
        "versions": _versions,
        "extras": _extras,
        "kernel": _kernel,
        "latency": _latency,
        "rendering": _rendering,
        "targets": _targets,
        "planners": _planners,
        "model files": _model_files,
        "memory": _memory,
        "connectors": _connectors,
        "gatekeepers": _gatekeepers,
    }
    return _print_findings([finding for name, check in checks.items() for finding in _run_check(check, name)])


def _print_findings(findings: list[Finding]) -> int:
    rows = [(finding.state, finding.item, finding.text) for finding in findings]
    print_table(("state", "item", "found"), rows, wrap_columns=("found",))
    problems = any(finding.state == "problem" for finding in findings)
    return ExitCode.SETUP if problems else ExitCode.SUCCESS


def _robot(robot: str) -> list[Finding]:
    """The missing information of one robot model; the kernel's capacity is checked too."""
    from dualbrain.robots.importer.output.markdown import missing_information
    from dualbrain.robots.importer.output.robot_folder import read_import_files
    from dualbrain.robots.loader import load_robot
    from dualbrain.safety.cbf.filter import SafetyFilter

    robot_model, folder = load_robot(robot), Path(robot)
    SafetyFilter(robot_model)
    report, _ = read_import_files(folder) if folder.is_dir() else (None, None)
    found = f"{robot_model.n} joints, {len(robot_model.spheres)} spheres, every bound with its provenance"
    return [
        Finding(robot_model.name, "ok", found),
        *(Finding("missing", "problem", line) for line in missing_information(robot_model, report)),
    ]


def _target(board: str, robot: str) -> list[Finding]:
    """Robot and kernel of the firmware on an emulated board, as the board states them."""
    from dualbrain.robots.loader import load_robot
    from dualbrain.safety.cbf.config import operating_config
    from dualbrain.safety.cbf.kernel import kernel_hash
    from dualbrain.safety.target.target_filter import EmulatedTarget

    robot_model = load_robot(robot)
    with EmulatedTarget(board, robot_model, operating_config(robot_model)) as target:
        stated = target.session.description
    kernel = f"{stated.kernel_hash:016x}"
    same = kernel == kernel_hash()
    comparison = "as on this computer" if same else f"this computer has {kernel_hash()}: build the firmware again"
    return [
        Finding(f"target {board}", "ok", f"{robot_model.name}, {stated.joints} joints, {stated.robot_hash:016x}"),
        Finding(f"kernel of {board}", "ok" if same else "problem", f"source hash {kernel}, {comparison}"),
    ]


def _targets() -> list[Finding]:
    """Whether the emulated boards can be built and started."""
    from dualbrain.safety.target.boards import BOARDS

    missing = [] if _version("ziglang") else ["pip install 'dualbrain[target]'"]
    missing += [] if shutil.which("qemu-system-arm") else ["apt-get install qemu-system-arm"]
    if missing:
        return [Finding("targets", "optional", f"no emulated board: {'; '.join(missing)}")]
    names = ", ".join(f"{board.name} ({board.core})" for board in BOARDS.values())
    return [Finding("targets", "ok", f"emulated boards {names}; their kernel: dualbrain doctor --target an386")]


def _run_check(check: Callable[[], list[Finding]], name: str) -> list[Finding]:
    try:
        return check()
    except ModuleNotFoundError as error:
        return [Finding(name, "optional", f"not checked: the package {error.name} is not installed")]
    except (DualbrainError, ImportError, OSError) as error:
        return [Finding(name, "problem", str(error))]


def _versions() -> list[Finding]:
    required = ", ".join(f"{part} {_version(part)}" for part in ("numpy", "msgspec", "jsonschema-rs", "filelock"))
    return [
        Finding("dualbrain", "ok", f"{__version__} on Python {platform.python_version()}"),
        Finding("packages", "ok", required),
    ]


def _extras() -> list[Finding]:
    def finding(extra: str, package: str) -> Finding:
        version = _version(package)
        if version:
            return Finding(f"extra {extra}", "ok", f"{package} {version}")
        return Finding(f"extra {extra}", "optional", f"not installed: pip install 'dualbrain[{extra}]'")

    return [finding(extra, package) for extra, package in OPTIONAL_PACKAGES]


def _version(name: str) -> str:
    """The installed version of a distribution, "" if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _kernel() -> list[Finding]:
    from dualbrain.safety.cbf.kernel import kernel_hash

    return [Finding("kernel", "ok", f"float32, C99, source hash {kernel_hash()}")]


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
    margin = max(tracking.row_margins(robot_model.alpha, robot_model.n))
    lag = f"lag {tracking.lag * 1e3:.2f} ms, margin α e of the rows up to {margin:.4f} rad/s"
    return [
        Finding("filter step", "ok", f"{statistics.median(times):.1f} µs median, scene 0, called from Python"),
        Finding("tracking model", "ok", f"{robot_model.name}: {lag} ({tracking.provenance})"),
    ]


def _rendering() -> list[Finding]:
    reason = choose_graphics(os.environ)
    from dualbrain.robots.loader import load_robot
    from dualbrain.simulation.perception.rendering import INSTALL_HINT, Camera
    from dualbrain.simulation.plant.plant import Plant
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    if reason:
        return [Finding("rendering", "optional", f"runs have no images: {reason}. {INSTALL_HINT}")]
    with Camera(Plant(open_scene("bare:0"), load_robot("panda")), width=64, height=48) as camera:
        image = camera.capture()
    gl = f"MUJOCO_GL={os.environ['MUJOCO_GL']}"
    if image.any():
        return [Finding("rendering", "ok", gl)]
    return [Finding("rendering", "problem", f"{gl} renders black images. {INSTALL_HINT}")]


def _planners() -> list[Finding]:
    """The planners that are part of the package."""
    from dualbrain.adaptation.adapters.packaged import packaged_names
    from dualbrain.cli.common.planner_choice import base_model, is_downloaded

    def finding(name: str) -> Finding:
        base = base_model(name)
        if is_downloaded(base, cache_folder()):
            return Finding(f"planner {name}", "ok", f"packaged adapter on {base}")
        fix = f"needs {base}: dualbrain models fetch {name}"
        return Finding(f"planner {name}", "optional", fix)

    return [finding(name) for name in packaged_names()]


def _model_files() -> list[Finding]:
    """The model files; where `dualbrain run` is installed, a missing text encoder is a problem: every run opens it."""
    from dualbrain.memory.embedding.text_encoder import ENCODER_WEIGHTS, TOKENIZER_WEIGHTS

    required = (ENCODER_WEIGHTS, TOKENIZER_WEIGHTS) if all(map(_is_importable, RUN_PACKAGES)) else ()

    def finding(status: weights.WeightStatus) -> Finding:
        name = status.file.name
        if status.present:
            return Finding(name, "ok", "verified" if status.verified else "present, verified at the next use")
        if name in required:
            return Finding(name, "problem", f"every `dualbrain run` needs it: dualbrain models fetch {name}")
        return Finding(name, "optional", f"not downloaded: dualbrain models fetch {name}")

    return [finding(status) for status in weights.list_weights(cache_folder())]


def _is_importable(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:
        return False


def _connectors() -> list[Finding]:
    """Every connector that an installed distribution announces; one that does not work is a problem."""
    from dualbrain.core.connectors import installed_connectors

    found: list[Finding] = []
    for one in installed_connectors():
        item = f"connector {one.name}"
        found += [Finding(item, "problem", f"{one.distribution}: {problem}") for problem in one.problems]
        found += [Finding(item, "ok", one.text)] if not one.problems else []
    return found


def _gatekeepers() -> list[Finding]:
    """Every gatekeeper of this user that runs; one that does not answer is a problem."""
    from dualbrain.cli.common.running_gatekeepers import running_gatekeepers

    return [
        Finding(f"gatekeeper {one.pid}", "problem" if one.commander is None else "ok", str(one))
        for one in running_gatekeepers(dualbrain_home())
    ] or [Finding("gatekeepers", "ok", "none is running")]


def _memory() -> list[Finding]:
    from dualbrain.memory.ledger.ledger import LedgerReader

    home = dualbrain_home()
    if found := _not_a_folder(home):
        fix = f"Runs store their memory in {home}: move {found}, or set DUALBRAIN_HOME to a folder."
        return [Finding("memory", "problem", f"{found} is not a folder. {fix}")]
    path: Path = home / "ledger.sqlite"
    if not path.exists():
        return [Finding("memory", "ok", "empty: no run yet")]
    with LedgerReader(path) as ledger:
        report = ledger.verify()
    chain = (
        "hash chain intact" if report.is_intact else f"hash chain broken at event {report.broken_at}: {report.fault}"
    )
    return [Finding("memory", "ok" if report.is_intact else "problem", f"{report.events} events, {chain}")]


def _not_a_folder(path: Path) -> Path | None:
    """`path` or the folder above it that exists but is no folder, so that `path` cannot be created; else None."""
    existing = next((one for one in (path, *path.parents) if os.path.lexists(one)), None)
    return None if existing is None or existing.is_dir() else existing
