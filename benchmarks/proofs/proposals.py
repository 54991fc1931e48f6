"""Contracts with random valid parameters, each carried out in its scene: a ledger of what became of them.

Nobody plans and nothing is chosen: instruction, scene and parameters are drawn by seed. All arms of a seed learn from
the same ones.
"""

from __future__ import annotations

import re
import tempfile
import time
from itertools import count
from pathlib import Path

from dualbrain.adaptation.lessons.lesson import SOURCE
from dualbrain.adaptation.sample import Sample, from_lines, to_lines
from dualbrain.cli import folders
from dualbrain.runtime.classroom import lessons
from dualbrain.runtime.given import GivenContract
from dualbrain.runtime.session import Onlooker, RunConfig, Session, Times
from proofs.steps import carry_on

ROBOT = "panda"
LEDGER, LINES = "ledger.sqlite", "proposals.jsonl"
TOGETHER = 20
"""Flights in one step."""
FIRST_SEED = 1000
"""Draws of the lessons that base-135m was taught are below."""
BEGAN, BETWEEN_S = 1_795_000_000.0, 240.0
"""Made-up date of the start [s, 1970 UTC], and time between two flights [s]."""


def flown(folder: Path, seed: int, number: int) -> Path:
    """The folder with the ledger of `number` flights and the lessons they came from; goes on where it was."""
    wanted = proposals(seed, number)

    def fly_some(step: int, here: Path) -> None:
        some = wanted[step * TOGETHER : (step + 1) * TOGETHER]
        for turn, one in enumerate(some, start=step * TOGETHER):
            fly(one, here / LEDGER, turn)
        with (here / LINES).open("ab") as lines:
            lines.write(to_lines(some))

    return carry_on(folder / f"seed {seed}, {number} flights", -(-number // TOGETHER), fly_some)


def proposals(seed: int, number: int) -> tuple[Sample, ...]:
    """What is proposed: instructions that ask for something to be done, without exemplars."""
    found = (one for one in lessons(2 * number, "teach", FIRST_SEED + seed, {ROBOT: 1.0}, exemplars=0.0))
    return tuple(one for one in found if '"skill":"decline"' not in one.contract)[:number]


def proposed(folder: Path) -> tuple[Sample, ...]:
    """The lessons of a folder that `flown` left."""
    return from_lines((folder / LINES).read_bytes())


def fly(one: Sample, ledger: Path, turn: int) -> str:
    """Carry out one contract with the filter on, remember it in `ledger`; how it ended by the robot's own verdict."""
    with tempfile.TemporaryDirectory(prefix="dualbrain-proposal-") as folder:
        config = RunConfig(
            instruction_of(one), Path(folder) / f"p-{turn}", ledger, folders.cache(), robot=ROBOT,
            scene=one.scene.removeprefix(f"{ROBOT} "), visuals=False, seed=turn, static=True,
        )  # fmt: skip
        dates = count(BEGAN + turn * BETWEEN_S, 1.0)
        times = Times(time.monotonic, "2026-11-21T00:00:00+00:00", lambda: next(dates))
        with Session(config, times, {}, GivenContract(SOURCE, one.contract.encode())) as session:
            return session.run(Onlooker()).episode.outcome.kind


def instruction_of(one: Sample) -> str:
    """The words of a lesson."""
    found = re.search("<instruction>\n(.*)\n</instruction>", one.prompt[-1]["content"])
    assert found is not None
    return found[1]
