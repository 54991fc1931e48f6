"""Ten million fuzzed frames and contracts, in process and at the socket of a running gatekeeper.

In process, a unit decodes frames with the code of the gatekeeper; contracts with a valid authentication code pass
through all three stages of the gate. At the socket, a gatekeeper in real time executes contracts while clients send
fuzzed frames as fast as it accepts connections, and its commander proposes fuzzed contracts with valid authentication
codes in between. A second gatekeeper executes the same contracts without fuzzing, for comparison.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dualbrain.contracts.contract import ContractHeader
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.verdict import Accepted
from dualbrain.control.gatekeeper.capability import Capability, full_capability
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.gate.contract_checker import ContractChecker
from dualbrain.control.gatekeeper.gate.exchange import GateRequest, GateSetup
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.protocol.authentication import load_keys, verify_contract_mac
from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
from dualbrain.control.gatekeeper.protocol.frames import BrokenStream, FrameDecoder
from dualbrain.control.gatekeeper.protocol.messages import Propose, RequestRefused, decode_message
from dualbrain.control.gatekeeper.timing.tick_timing import TickTimingSummary
from dualbrain.grounding.offline_gate import scene_from_spec
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.skills.registry import skill_registry
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.interfaces.fuzzer import Fuzzer
from experiments.safety.closed_loop import pick_and_place_actions

N_FRAMES = 10_000_000
FRAMES_PER_UNIT = 250_000
N_SERVER_RUNS, RUN_SECONDS, N_CLIENTS = 4, 30.0, 2
"""Runs at the socket, duration of each with and without fuzzing [s], fuzzing clients per run."""
REJECTION_PAUSE_S = 0.02
"""Pause after a contract that is not fuzzed [s]; without it, rejected contracts would count as a flood."""
WARM_UP_FRAMES = 2_000
"""Frames before the first measurement of resident memory."""
SCENE = "tabletop:1"
SECRET, NONCE = b"s" * 32, b"n" * 16
CLIENT_SCRIPT = Path(__file__).with_name("fuzz_client.py")
GATE_RAISED, GATE_FAILURE_HINTS = "the gate raised", ("the gate failed", "a rule failed")
"""Count for contracts at which the gate raised, and the hints by which such a rejection is recognized."""
CATEGORY_NAMES = {
    "streams broken": "malformed streams",
    "frames cut": "incomplete frames",
    "messages refused": "rejected messages",
    "seals refused": "invalid authentication codes",
}
"""Printed names of counts whose stored name differs."""


class FuzzSocket:
    """Each fuzzed frame yields a message, a verdict or a rejection."""

    name = "fuzz_socket"
    claim = (
        "10⁷ fuzzed frames and contracts each yield a message, a verdict or a rejection: no exception is raised and "
        "memory does not grow. Fuzzing the socket of a running gatekeeper does not disturb its control tick."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Return the units by seed, then the runs at the socket, whose times need an otherwise idle machine."""
        del options
        seeds = [
            WorkUnit(f"seed {seed}", {"seed": seed, "frames": FRAMES_PER_UNIT})
            for seed in range(N_FRAMES // FRAMES_PER_UNIT)
        ]
        return seeds + [
            WorkUnit(f"door {seed}", {"door": seed, "seconds": RUN_SECONDS}) for seed in range(N_SERVER_RUNS)
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run a unit in process, or one at the socket."""
        if "door" in parameters:
            return {"door": True, **_fuzz_server(parameters["door"], parameters["seconds"])}
        return {"door": False, **_fuzz_in_process(parameters["seed"], parameters["frames"])}

    def summarize_row(self, row: Row) -> str:
        """Summarize the row for the progress line."""
        if not row["door"]:
            return f"{row['frames']} frames, {row['counts']}, grown by {row['grown_kib']} KiB"
        without, fuzzed = (1e3 * row[name]["interval"][2] for name in ("calm", "fuzzed"))
        return f"{row['said']}, 99.9 % of intervals {without:.2f} → {fuzzed:.2f} ms, RSS {row['rss_kib']}"

    def report(self, rows: list[Row]) -> list[str]:
        """Report the runs in process, then those at the socket."""
        in_process, at_socket = ([row for row in rows if row["door"] is value] for value in (False, True))
        lines = _in_process_report(in_process) if in_process else []
        return lines + (_server_report(at_socket) if at_socket else [])


# --- in process ---------------------------------------------------------------------------------------------------


def _fuzz_in_process(seed: int, frames: int) -> Row:
    """Feed frames, half of which carry a contract with a valid authentication code for this connection."""
    fuzzer, checker, request = Fuzzer(seed), *_checker_and_request()
    counts: Counter[str] = Counter()
    _feed_frames(fuzzer, checker, request, range(WARM_UP_FRAMES), Counter())
    before, start = resident_kib(), time.monotonic()
    _feed_frames(fuzzer, checker, request, range(WARM_UP_FRAMES, WARM_UP_FRAMES + frames), counts)
    spent, grown = time.monotonic() - start, resident_kib() - before
    return {"frames": frames, "counts": counts, "grown_kib": grown, "seconds": spent}


def _checker_and_request() -> tuple[ContractChecker, GateRequest]:
    """Return a contract checker and a request that lacks only its contract."""
    robot_model = load_robot("panda")
    scene = scene_from_spec(open_scene(SCENE))
    q = np.array(robot_model.home)
    state = RobotState(
        stamp=0.0,
        sequence=1,
        q=q,
        v=np.zeros(robot_model.n),
        opening=0.04,
        finger_forces=(0.0, 0.0),
        drive_enabled=True,
    )
    stamp = ContractHeader(sequence=1, issued=0.0, expires=60.0, principal=PLANNER, scene_version=scene.version)
    setup = GateSetup(robot_model=robot_model, capabilities={PLANNER: full_capability(skill_registry(robot_model))})
    return ContractChecker(setup), GateRequest(
        connection_number=1, sequence=1, contract=b"", stamp=stamp, now=1.0, scene=scene, state=state, holding=None
    )


def _feed_frames(
    fuzzer: Fuzzer, checker: ContractChecker, request: GateRequest, numbers: range, counts: Counter[str]
) -> None:
    decoder, sequence = FrameDecoder(), 0
    for number in numbers:
        sequence += 1
        version = request.scene.version
        if fuzzer.rng.random() < 0.5:
            sent = fuzzer.authenticated_proposal(SECRET, NONCE, sequence, version, 0.0)
        else:
            sent = fuzzer.message()
        decoder.feed(fuzzer.frame(sent, sequence))
        frame = decoder.next_frame()
        if frame is None or isinstance(frame, BrokenStream):
            counts["streams broken" if frame else "frames cut"] += 1
            decoder, sequence = FrameDecoder(), 0
            continue
        message = decode_message(frame, from_client=True)
        if isinstance(message, str):
            counts["messages refused"] += 1
        elif not isinstance(message, Propose):
            counts["messages"] += 1
        elif not verify_contract_mac(SECRET, NONCE, frame.sequence, message):
            counts["seals refused"] += 1
        else:
            counts[_classify_contract(checker, request, message, number)] += 1


def _classify_contract(checker: ContractChecker, request: GateRequest, message: Propose, number: int) -> str:
    """Return the stage that rejected a contract, or that it was accepted."""
    stamp = msgspec.structs.replace(request.stamp, sequence=(1 << 32) + number)
    verdict = checker.check(msgspec.structs.replace(request, contract=message.contract, stamp=stamp))
    if isinstance(verdict, Accepted):
        return "contracts accepted"
    return GATE_RAISED if verdict.hint in GATE_FAILURE_HINTS else f"contracts refused: {verdict.stage}"


def _in_process_report(rows: list[Row]) -> list[str]:
    counts = sum((Counter(row["counts"]) for row in rows), Counter())
    frames, spent = (sum(row[name] for row in rows) for name in ("frames", "seconds"))
    contracts = sum(count for kind, count in counts.items() if kind.startswith("contracts"))
    grown = max(row["grown_kib"] for row in rows)
    lines = [
        f"In process: **{frames:,}** frames, among them **{contracts:,}** contracts that reached the gate. Exceptions: "
        f"**{counts[GATE_RAISED]}**. Largest growth of a process within {FRAMES_PER_UNIT:,} frames: {grown:,} KiB. "
        f"{1e6 * spent / frames:.0f} µs per frame.",
        "",
    ]
    results = ((_category(kind), f"{count:,}", f"{count / frames:.2%}") for kind, count in counts.most_common())
    return lines + markdown_table(("result", "frames", "share"), results)


def _category(kind: str) -> str:
    return CATEGORY_NAMES.get(kind, kind.replace("refused:", "rejected:"))


# --- at the socket ------------------------------------------------------------------------------------------------


def _fuzz_server(seed: int, seconds: float) -> Row:
    calm, _, _, _ = _run_gatekeeper(seed, seconds, clients=0)
    fuzzed, counts, verdicts, rss = _run_gatekeeper(seed, seconds, clients=N_CLIENTS)
    return {"calm": calm, "fuzzed": fuzzed, "said": counts, "verdicts": verdicts, "rss_kib": rss, "seconds": seconds}


def _run_gatekeeper(seed: int, seconds: float, clients: int) -> tuple[Any, Counter[str], Counter[str], list[int]]:
    """Run a gatekeeper and its commander for `seconds` with fuzzing clients.

    Returns the tick timing, the counts of the clients, the verdicts, and the resident memory before and after [KiB].
    """
    with tempfile.TemporaryDirectory(prefix="dualbrain-") as name:
        folder = Path(name)
        skills = frozenset(skill_registry(load_robot("panda")).by_name)
        config = GatekeeperConfig(
            robot="panda",
            scene=open_scene(SCENE),
            socket=str(folder / "s"),
            keys=str(folder / "keys"),
            tick_timing=str(folder / "p.json"),
            capability=Capability(skills, rate=1e6),
        )
        process = GatekeeperProcess(config)
        try:
            commander = GatekeeperClient(folder / "s", load_keys(folder / "keys", (PLANNER,)), PLANNER)
            _run_pick_and_place(commander)
            before = resident_kib(process.process.pid)
            children = [_start_client(config.socket, seconds, 100 * seed + k) for k in range(clients)]
            verdicts = _run_commander(commander, Fuzzer(seed) if clients else None, time.monotonic() + seconds)
            counts = Counter[str]()
            for child in children:
                counts.update(msgspec.json.decode(child.communicate()[0], type=dict[str, int]))
            after = resident_kib(process.process.pid)
            commander.close()
        finally:
            process.stop()
        found = msgspec.json.decode((folder / "p.json").read_bytes(), type=TickTimingSummary)
    kept = ("ticks", "missed", "late", "interval", "work", "latency")
    return {name: getattr(found, name) for name in kept}, counts, verdicts, [before, after]


def _start_client(path: str, seconds: float, seed: int) -> subprocess.Popen[bytes]:
    flags = ["-S"] if sys.flags.no_site else []
    return subprocess.Popen(
        [sys.executable, *flags, str(CLIENT_SCRIPT), path, str(seconds), str(seed)], stdout=subprocess.PIPE
    )


def _run_commander(link: GatekeeperClient, fuzzer: Fuzzer | None, until: float) -> Counter[str]:
    """Run pick and place contracts with fuzzed contracts in between; count the verdicts of the fuzzed ones."""
    verdicts: Counter[str] = Counter()
    while time.monotonic() < until:
        _run_pick_and_place(link)
        time.sleep(REJECTION_PAUSE_S)
        for _ in range(200 if fuzzer else 0):
            verdicts[_propose(link, fuzzer.contract() if fuzzer else b"")] += 1
            time.sleep(0.004)
    return verdicts


def _run_pick_and_place(link: GatekeeperClient) -> None:
    context = {"robot": link.welcome.robot, "registry": link.welcome.registry}
    _propose(
        link,
        msgspec.json.encode({"id": "c-0001", "context": context, "action_sequence": pick_and_place_actions(speed=0.3)}),
    )


def _propose(link: GatekeeperClient, text: bytes) -> str:
    """Propose a contract and return its verdict, after the execution if it was accepted."""
    answer = link.propose(text, link.request_scene().scene.version)
    if isinstance(answer, RequestRefused):
        return "not considered"
    if answer.rejected is not None:
        return f"refused: {answer.rejected.stage}"
    return f"accepted, {link.wait_for_outcome(120.0).outcome.kind}"


def _server_report(rows: list[Row]) -> list[str]:
    sent, verdicts = (sum((Counter(row[name]) for row in rows), Counter()) for name in ("said", "verdicts"))
    judged = ", ".join(f"{_category(kind)} {count}" for kind, count in verdicts.most_common())
    grown = max(row["rss_kib"][1] - row["rss_kib"][0] for row in rows)
    spent = sum(row["seconds"] for row in rows)
    lines = [
        f"At the socket of a running gatekeeper, {spent:.0f} s with {N_CLIENTS} fuzzing clients: "
        f"**{sent['frames']:,}** frames on {sent['connections']:,} connections. The gatekeeper closed "
        f"{sent['refused']:,} of them, the client {sent['left']:,}; **{sent['not hung up']}** stayed open although "
        f"their frame must end them. Contracts with valid authentication codes: {sum(verdicts.values()):,} "
        f"({judged}). Largest growth of a gatekeeper: {grown:,} KiB.",
        "",
    ]
    head = ("interval between ticks, worst run", "median", "99 %", "99.9 %", "longest", "late ticks", "states missed")
    return [
        "",
        *lines,
        *markdown_table(
            head, (_jitter_row(rows, "calm", "without fuzzing"), _jitter_row(rows, "fuzzed", "with fuzzing"))
        ),
    ]


def _jitter_row(rows: list[Row], name: str, label: str) -> tuple[object, ...]:
    worst = [max(row[name]["interval"][k] for row in rows) for k in range(4)]
    ticks, late, missed = (sum(row[name][key] for row in rows) for key in ("ticks", "late", "missed"))
    return (label, *(f"{1e3 * value:.2f} ms" for value in worst), f"{late} ({late / max(1, ticks):.2%})", missed)


def resident_kib(pid: int | str = "self") -> int:
    """Return the resident memory of a process [KiB]."""
    text = Path(f"/proc/{pid}/status").read_text()
    return int(next(line.split()[1] for line in text.splitlines() if line.startswith("VmRSS")))
