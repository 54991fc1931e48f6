"""Learning in one scene, repeated thirty times, with dynamic and with static memory weights from the same start.

Each seed has its own start: six contracts with random valid parameters, executed in the scene and stored with the
robot's own verdict. Both arms begin with a copy of that ledger, so only the weights differ; ε is the median Δ of its
successes. Ground truth is used for the tables only.
"""

from __future__ import annotations

import json
import re
import tempfile
import time
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dualbrain.core import paths
from dualbrain.core.storage.resumable_steps import run_steps
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.plasticity.hebbian_update import EPSILON
from dualbrain.memory.state.derivation import derive_state
from dualbrain.planner.protocol import Planner
from dualbrain.planner.scripted import FixedContractPlanner
from dualbrain.records import Episode
from dualbrain.runtime.session import Clocks, RunConfig, RunObserver, Session
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.planning.end_to_end import GOAL, cached_planner
from experiments.planning.verdict_confusion import confusion_table
from experiments.safety.closed_loop import pick_and_place_actions

SCENES, N_SEEDS, N_REPETITIONS, N_START_CONTRACTS = ("tall_ii:301", "shelf_ii:302", "forearm_ii:303"), 5, 30, 6
"""Scenes of level II, where the contract matters (experiment `sensitivity_sweep`), with seeds outside that sweep."""
INSTRUCTION = "put the red cube in the bowl"
PARAMETER_GRID: dict[str, tuple[Any, ...]] = {
    "clearance": (0.08, 0.15, 0.2, 0.3),
    "finger_axis": ("along", "across"),
    "approach": ("top", "tilted"),
    "route": ("direct", "near_base", "left", "right"),
    "opening": (0.055, 0.08),
}
START_TIME, EPISODE_SPACING_S = 1_795_000_000.0, 240.0
"""Fixed date of the start [s since 1970 UTC], and interval between two episodes [s]."""
LEDGER_FILE, EPISODES_FILE = "ledger.sqlite", "episodes.json"


class Learning:
    """Repeated scenes."""

    name = "learning"
    claim = (
        "One scene 30 times from the same start, with 5 new ledgers: Δ and decision time over the repetitions with "
        "dynamic and with static weights; the scores of good and bad memories separate."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Scene by scene, seed by seed, both arms; one scene has ten units."""
        return [
            WorkUnit(
                f"{scene} seed {seed} {arm}, {options.planner}",
                {
                    "scene": scene,
                    "seed": seed,
                    "arm": arm,
                    "planner": options.planner,
                    "repetitions": N_REPETITIONS,
                    "folder": str(options.folder / "learning"),
                },
            )
            for scene in SCENES
            for seed in range(N_SEEDS)
            for arm in ("dynamic", "static")
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run the start, which both arms share, then the repetitions; the row contains the ledger's head.

        Each episode is a resumable step: a unit that is started again continues with the next one.
        """
        folder, row = (
            Path(parameters["folder"]),
            {name: value for name, value in parameters.items() if name != "folder"},
        )
        place = f"{parameters['scene']} seed {parameters['seed']}".replace(":", "-")
        planner, arm = (
            cached_planner(parameters["planner"]),
            f"{place} {parameters['arm']}, {_file_name_part(parameters['planner'])}",
        )
        start = run_steps(
            folder / f"{place} start",
            N_START_CONTRACTS,
            lambda number, step_folder: _store_start_contract(step_folder, parameters, number),
        )
        row["epsilon"] = median_success_delta(start / LEDGER_FILE)
        repeat = partial(_run_repetition, parameters=parameters, planner=planner, epsilon=row["epsilon"])
        last = run_steps(folder / arm, parameters["repetitions"], repeat, initial_folder=start)
        with LedgerReader(last / LEDGER_FILE) as reader:
            head, state = reader.head(), derive_state(reader)
            separation = weight_separation(reader)
        weights = {one.id: [one.weight, one.kind, one.Delta] for one in state.memories}
        episodes = json.loads((last / EPISODES_FILE).read_text())
        fields = {"ledger": head.hash, "events": head.seq, "weights": weights, "parted": separation}
        return {**row, "episodes": episodes, **fields}

    def summarize_row(self, row: Row) -> str:
        """Mean Δ of the first and the last third."""
        first, last = mean_delta_of_thirds(row)
        return f"Δ {first:.4f} -> {last:.4f}, ledger {row['ledger'][:12]}"

    def report(self, rows: list[Row]) -> list[str]:
        """Δ of the first and the last ten repetitions, by arm and scene; the ledgers' heads."""
        lines: list[tuple[object, ...]] = []
        for scene in SCENES:
            for arm in ("dynamic", "static"):
                some = [row for row in rows if (row["scene"], row["arm"]) == (scene, arm)]
                if some:
                    ends = np.array([mean_delta_of_thirds(row) for row in some])
                    good = [np.mean([one["outcome"] == "succeeded" for one in row["episodes"]]) for row in some]
                    times = [np.mean([one["decision_s"] for one in row["episodes"]]) for row in some]
                    heads = ", ".join(row["ledger"][:8] for row in some)
                    cells = [f"{np.mean(x):.4f} ± {np.std(x):.4f}" for x in (ends[:, 0], ends[:, 1])]
                    lines.append(
                        (scene, arm, len(some), *cells, f"{np.mean(good):.2f}", f"{np.mean(times):.1f}", heads)
                    )
        head = ("scene", "w", "ledgers", "Δ, first ten", "Δ, last ten", "succeeded", "decision [s]", "ledger heads")
        episodes = [one for row in rows for one in row["episodes"]]
        return [*markdown_table(head, lines), *compare_arms(rows), *confusion_table(episodes)]


def start_contracts(seed: int) -> list[list[dict[str, Any]]]:
    """Six contracts with random valid parameters, without selection."""
    rng = np.random.default_rng([seed, 17])
    return [
        pick_and_place_actions(**{name: rng.choice(values).item() for name, values in PARAMETER_GRID.items()})
        for _ in range(N_START_CONTRACTS)
    ]


def repetition_row(episode: Episode) -> dict[str, Any]:
    """The row of one repetition: the robot's verdict, Δ, planning time, the best exemplar, and ground truth."""
    best = episode.recall.exemplars[0] if episode.recall.exemplars else None
    return {
        "outcome": episode.outcome.kind,
        "Delta": episode.outcome.Delta,
        "decision_s": episode.timings["planner"],
        "motion_s": episode.outcome.duration,
        "best": best.episode_id if best else None,
        "best_score": best.score if best else None,
        "second_opinion": episode.second_opinion,
        "truth": bool(episode.judgement and episode.judgement.success),
        "contract": (episode.contract or {}).get("action_sequence"),
    }


def median_success_delta(ledger: Path) -> float:
    """Median Δ of the successes in a ledger, or the default ε without successes."""
    with LedgerReader(ledger) as reader:
        sizes = [one.Delta for one in derive_state(reader).memories if one.r and one.Delta is not None]
    return float(np.median(sizes)) if sizes else EPSILON


def mean_delta_of_thirds(row: Row) -> tuple[float, float]:
    """Mean Δ of the first and the last third of the repetitions, without those that did not move."""
    found = [one["Delta"] for one in row["episodes"]]
    third = max(1, len(found) // 3)
    parts = ([x for x in part if x is not None] for part in (found[:third], found[-third:]))
    first, last = (float(np.mean(part)) if part else float("nan") for part in parts)
    return first, last


def compare_arms(rows: list[Row]) -> list[str]:
    """Dynamic against static weights from the same start, in the last third, by Δ and by rejected contracts."""
    pairs: dict[tuple[str, int], dict[str, Row]] = {}
    for row in rows:
        pairs.setdefault((row["scene"], row["seed"]), {})[row["arm"]] = row
    both = [pair for pair in pairs.values() if len(pair) == 2]
    if not both:
        return []
    differences = np.array(
        [mean_delta_of_thirds(pair["dynamic"])[1] - mean_delta_of_thirds(pair["static"])[1] for pair in both]
    )
    lower, higher = int(np.sum(differences < 0.0)), int(np.sum(differences > 0.0))
    rejected = {arm: sum(one["Delta"] is None for pair in both for one in pair[arm]["episodes"]) for arm in both[0]}
    total = sum(len(pair["dynamic"]["episodes"]) for pair in both)
    return [
        f"Last ten repetitions, dynamic weights against static ones from the same start: Δ lower in {lower} of "
        f"{len(both)} ledgers, higher in {higher}; mean difference {np.nanmean(differences):+.4f}. Rejected "
        f"contracts: {rejected['dynamic']} of {total} with dynamic weights, {rejected['static']} of {total} with "
        "static ones.",
        "",
    ]


def weight_separation(ledger: LedgerReader) -> list[list[float]]:
    """(event, mean weight of good memories, mean weight of all others); good: success with Δ at most the median."""
    state = derive_state(ledger)
    sizes = [one.Delta for one in state.memories if one.r and one.Delta is not None]
    middle = float(np.median(sizes)) if sizes else 0.0
    good = {one.id for one in state.memories if one.r and one.Delta is not None and one.Delta <= middle}
    weights: dict[str, float] = {}
    curve: list[list[float]] = []
    for event in ledger.events("episode", "weight"):
        payload = msgspec.json.decode(event.payload)
        weights[event.subject] = payload["after"] if event.kind == "weight" else payload["w0"]
        means = [
            np.mean([w for name, w in weights.items() if (name in good) == side] or [0.5]) for side in (True, False)
        ]
        curve.append([float(event.seq), *map(float, means)])
    return curve


def _store_start_contract(folder: Path, parameters: dict[str, Any], number: int) -> None:
    """Run one contract of the start with the ledger in `folder`; no weight changes."""
    actions = start_contracts(parameters["seed"])[number]
    _run_episode(
        folder / LEDGER_FILE,
        parameters,
        FixedContractPlanner("start", _contract_bytes(actions)),
        f"s-{number}",
        number,
        static=True,
    )


def _run_repetition(number: int, folder: Path, parameters: dict[str, Any], planner: Planner, epsilon: float) -> None:
    """Run one repetition with the ledger in `folder`, and append it to the file of episodes."""
    static, turn = parameters["arm"] == "static", N_START_CONTRACTS + number
    episode = _run_episode(
        folder / LEDGER_FILE, parameters, planner, f"r-{number}", turn, static=static, epsilon=epsilon
    )
    file = folder / EPISODES_FILE
    episodes = json.loads(file.read_text()) if file.exists() else []
    file.write_text(json.dumps([*episodes, repetition_row(episode)]))


def _run_episode(
    ledger: Path,
    parameters: dict[str, Any],
    planner: Planner,
    name: str,
    turn: int,
    *,
    static: bool,
    epsilon: float = 0.0,
) -> Episode:
    """One run in the scene, the `turn`-th with this ledger; the dates do not depend on the machine."""
    with tempfile.TemporaryDirectory(prefix="dualbrain-learning-run-") as folder:
        seed = parameters["seed"] * 1000 + int(name.split("-")[1]) + 500 * name.startswith("r")
        config = RunConfig(
            instruction=INSTRUCTION,
            out=Path(folder) / name,
            ledger=ledger,
            cache=paths.cache_folder(),
            scene=parameters["scene"],
            goal=GOAL,
            visuals=False,
            seed=seed,
            static=static,
            epsilon=epsilon,
        )
        dates = count(START_TIME + turn * EPISODE_SPACING_S, 1.0)
        clocks = Clocks(time.monotonic, "2026-11-21T00:00:00+00:00", lambda: next(dates))
        with Session(config, clocks, {}, planner) as session:
            return session.run(RunObserver()).episode


def _file_name_part(name: str) -> str:
    """`name` as a part of a file name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name)


def _contract_bytes(actions: list[dict[str, Any]]) -> bytes:
    context = {"robot": "panda", "registry": load_skill_registry("panda").hash}
    return msgspec.json.encode({"id": "c-0001", "context": context, "action_sequence": actions})
