"""Contracts that somebody proposed, each carried out in its scene with the filter on: a ledger of what became of them.

`proposals` are drawn by seed, with random valid parameters: nobody plans, and nothing is chosen by what comes of it.
Any other proposal is a lesson with another contract and another author in it.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from itertools import count
from pathlib import Path

from dualbrain.adaptation.curation.sample import Sample, from_lines, to_lines
from dualbrain.contracts.schema import decoding_schema, short_form
from dualbrain.core.storage.resumable_steps import carry_on
from dualbrain.planner.request import PlanRequest
from dualbrain.planner.scripted import GivenContract
from dualbrain.records import Episode, Recall
from dualbrain.runtime.data_collection.synthetic_scenes import lessons, setting_of
from dualbrain.runtime.session import Onlooker, RunConfig, Session, Times

ROBOT = "panda"
LEDGER, LINES = "ledger.sqlite", "proposals.jsonl"
TOGETHER = 10
"""Flights in one step."""
FIRST_SEED = 1000
"""Draws of the lessons that base-135m was taught are below."""
EPSILON = 0.0021
"""ε of what a Panda may learn from: that of its memory in suite `paper`, from its pilot."""
STARTED, BEGAN, BETWEEN_S = "2026-11-21T00:00:00+00:00", 1_795_000_000.0, 240.0
"""Made-up date of the start, also in seconds [s, 1970 UTC], and time between two flights [s]."""


def proposals(seed: int, number: int, *, declines: bool = False) -> tuple[Sample, ...]:
    """What is proposed, without exemplars: instructions that ask for a deed; with `declines`, also what cannot be done.

    The latter come as often as lessons have them.
    """
    found = lessons(number if declines else 2 * number, "teach", FIRST_SEED + seed, {ROBOT: 1.0}, exemplars=0.0)
    return tuple(one for one in found if declines or not declined(one))[:number]


def declined(one: Sample) -> bool:
    """Whether its contract is to decline."""
    return '"skill":"decline"' in one.contract


def flown(
    folder: Path, number: int, propose: Callable[[int], Sample], *, cache: Path, first: int = 0,
    start: Path | None = None, tell: Callable[[int, Episode], None] = lambda done, episode: None,
) -> Path:  # fmt: skip
    """The folder with the ledger of `number` proposals that were carried out, and with the proposals themselves.

    `propose(turn)` is asked from turn `first` on. `start` is such a folder to begin with. Stopped in any way, the same
    call goes on where it was, and ends with the same ledger. `tell` hears how many are done after each flight.
    """

    def fly_some(step: int, here: Path) -> None:
        for done in range(step * TOGETHER, min(number, (step + 1) * TOGETHER)):
            one = propose(first + done)
            episode = carried_out(one, here / LEDGER, first + done, cache=cache)
            with (here / LINES).open("ab") as lines:
                lines.write(to_lines((one,)))
            tell(done + 1, episode)

    return carry_on(folder, -(-number // TOGETHER), fly_some, start=start)


def proposed(folder: Path) -> tuple[Sample, ...]:
    """The proposals of a folder that `flown` left, by turn."""
    return from_lines((folder / LINES).read_bytes())


def carried_out(one: Sample, ledger: Path, turn: int, *, cache: Path) -> Episode:
    """Carry out the contract of `one` in its scene, whatever it is, and remember it in `ledger`.

    Its author is the sample's source. Dates are made up, all clocks stand still, and nothing is learnt meanwhile:
    promise: the ledger depends on the proposals and their order alone.
    """
    robot, _, scene = one.scene.partition(" ")
    with tempfile.TemporaryDirectory(prefix="dualbrain-proposal-") as folder:
        config = RunConfig(
            instruction_of(one), Path(folder) / memory_of(turn), ledger, cache, robot=robot, scene=scene, visuals=False,
            seed=turn, shots=1, static=True,
        )  # fmt: skip
        dates = count(BEGAN + turn * BETWEEN_S, 1.0)
        times = Times(lambda: 0.0, STARTED, lambda: next(dates))
        given = GivenContract(one.source, one.contract.encode("utf-8", "surrogatepass"))
        with Session(config, times, {}, given) as session:
            return session.run(Onlooker()).episode


def memory_of(turn: int) -> str:
    """The name of the memory of a turn."""
    return f"p-{turn}"


def turn_of(memory: str) -> int:
    """The turn that a memory of such a ledger is of."""
    return int(memory.removeprefix("p-"))


def request_of(one: Sample, recall: Recall | None = None) -> PlanRequest:
    """The question of a lesson as the loop asks it, with what was recalled."""
    setting = setting_of(one.scene)
    registry, names = setting.registry, setting.names
    return PlanRequest(
        instruction_of(one), setting.summary, recall or Recall(), registry.robot, registry.hash,
        short_form(registry, names), decoding_schema(registry, names), contract_id="c-0001",
    )  # fmt: skip


def instruction_of(one: Sample) -> str:
    """The words of a lesson."""
    found = re.search("<instruction>\n(.*)\n</instruction>", one.prompt[-1]["content"])
    assert found is not None
    return found[1]
