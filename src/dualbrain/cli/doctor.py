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
from dualbrain.cli.common.console import listing
from dualbrain.cli.common.exit_codes import Exit
from dualbrain.cli.common.graphics import choose_graphics
from dualbrain.cli.common.paths import cache, home
from dualbrain.core import weights
from dualbrain.errors import DualbrainError


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the examination: `good` False means something is missing, and `text` says how to get it."""

    what: str
    good: bool
    text: str


def doctor(*, robot: str = "") -> int:
    """Examine this installation: versions, kernel, rendering, models, memory, latency of one filter step.

    Parameters
    ----------
    robot
        Examine this robot instead: a known name, or a folder that `dualbrain robot init` made.
    """
    if robot:
        return _told(_robot(robot))
    examinations = (_versions, _kernel, _latency, _rendering, _models, _memory)
    return _told([finding for examine in examinations for finding in _safely(examine)])


def _told(findings: list[Finding]) -> int:
    rows = [("ok" if finding.good else "--", finding.what, finding.text) for finding in findings]
    listing(("", "what", "found"), rows, gives=("found",))
    return Exit.SUCCESS if all(finding.good for finding in findings) else Exit.SETUP


def _robot(robot: str) -> list[Finding]:
    """What is missing of one robot; whether the kernel has room for it."""
    from dualbrain.robots.importer.output.markdown import gaps
    from dualbrain.robots.importer.output.robot_folder import read_report
    from dualbrain.robots.loader import load_body
    from dualbrain.safety.cbf.filter import SafetyFilter

    body, folder = load_body(robot), Path(robot)
    SafetyFilter(body)
    report, _ = read_report(folder) if folder.is_dir() else (None, None)
    found = f"{body.n} joints, {len(body.spheres)} spheres, every bound with its provenance"
    return [Finding(body.name, True, found), *(Finding("missing", False, line) for line in gaps(body, report))]


def _safely(examine: Callable[[], list[Finding]]) -> list[Finding]:
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
    from dualbrain.grounding.offline_gate import as_specified
    from dualbrain.robots.interface import at_home
    from dualbrain.robots.loader import load_body
    from dualbrain.safety.cbf.filter import SafetyFilter
    from dualbrain.safety.cbf.obstacles import from_scene
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    body = load_body("panda")
    safety, state = SafetyFilter(body), at_home(body)
    safety.observe(from_scene(as_specified(open_scene("0")), known=(), held=None), 0.0)
    times: list[float] = []
    for _ in range(2000):
        start = time.perf_counter()
        safety.filter(state, state.v, 0.0)
        times.append((time.perf_counter() - start) * 1e6)
    tracking = body.tracking
    lag = f"lag {tracking.lag * 1e3:.2f} ms, rows keep {tracking.budget(body.alpha):.4f} rad/s"
    return [
        Finding("filter step", True, f"{statistics.median(times):.1f} µs median, scene 0, from Python"),
        Finding("tracking model", True, f"{body.name}: {lag} ({tracking.provenance})"),
    ]


def _rendering() -> list[Finding]:
    why = choose_graphics(os.environ)
    from dualbrain.robots.loader import load_body
    from dualbrain.simulation.perception.rendering import INSTALL, Camera
    from dualbrain.simulation.plant.plant import Plant
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    if why:
        return [Finding("rendering", False, f"{why}. {INSTALL}")]
    with Camera(Plant(open_scene("bare:0"), load_body("panda")), width=64, height=48) as camera:
        picture = camera.snap()
    return [Finding("rendering", bool(picture.any()), f"MUJOCO_GL={os.environ['MUJOCO_GL']}")]


def _models() -> list[Finding]:
    def one(status: weights.WeightStatus) -> Finding:
        good = status.verified
        return Finding(
            status.file.name, good, "verified" if good else f"not here: dualbrain models fetch {status.file.name}"
        )

    return [one(status) for status in weights.list_weights(cache())]


def _memory() -> list[Finding]:
    from dualbrain.memory.ledger.ledger import LedgerReader

    path: Path = home() / "ledger.sqlite"
    if not path.exists():
        return [Finding("memory", True, "empty: no run yet")]
    with LedgerReader(path) as ledger:
        report = ledger.verify()
    state = "chain whole" if report.whole else f"damaged at event {report.broken_at}: {report.fault}"
    return [Finding("memory", report.whole, f"{report.events} events, {state}")]
