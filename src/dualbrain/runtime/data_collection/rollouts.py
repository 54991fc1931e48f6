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

from dualbrain.adaptation.curation.sample import Sample, decode_samples, encode_samples
from dualbrain.contracts.schema import decoding_schema, describe_skills
from dualbrain.core.storage.resumable_steps import run_steps
from dualbrain.planner.request import PlanRequest
from dualbrain.planner.scripted import FixedContractPlanner
from dualbrain.records import Episode, RetrievedContext
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples, scene_context_by_name
from dualbrain.runtime.session import Clocks, RunConfig, RunObserver, Session

ROBOT = "panda"
LEDGER_FILE, PROPOSALS_FILE = "ledger.sqlite", "proposals.jsonl"
EPISODES_PER_STEP = 10
"""Flights in one step."""
FIRST_SEED = 1000
"""Draws of the lessons that base-135m was taught are below."""
EPSILON = 0.0021
"""ε of what a Panda may learn from: that of its memory in suite `paper`, from its pilot."""
START_DATE, START_TIME_S, EPISODE_INTERVAL_S = "2026-11-21T00:00:00+00:00", 1_795_000_000.0, 240.0
"""Made-up date of the start, also in seconds [s, 1970 UTC], and time between two flights [s]."""


def draw_proposals(seed: int, number: int, *, include_declines: bool = False) -> tuple[Sample, ...]:
    """What is proposed, without exemplars: instructions that ask for a deed; with `declines`, also what cannot be done.

    The latter come as often as lessons have them.
    """
    found = generate_examples(
        number if include_declines else 2 * number, "teach", FIRST_SEED + seed, {ROBOT: 1.0}, exemplar_share=0.0
    )
    return tuple(one for one in found if include_declines or not is_declined(one))[:number]


def is_declined(one: Sample) -> bool:
    """Whether its contract is to decline."""
    return '"skill":"decline"' in one.contract


def run_proposals(
    folder: Path,
    number: int,
    propose: Callable[[int], Sample],
    *,
    cache: Path,
    first_turn: int = 0,
    initial_folder: Path | None = None,
    on_episode: Callable[[int, Episode], None] = lambda done, episode: None,
) -> Path:
    """The folder with the ledger of `number` proposals that were carried out, and with the proposals themselves.

    `propose(turn)` is asked from turn `first` on. `start` is such a folder to begin with. Stopped in any way, the same
    call goes on where it was, and ends with the same ledger. `tell` hears how many are done after each flight.
    """

    def fly_some(step: int, here: Path) -> None:
        for done in range(step * EPISODES_PER_STEP, min(number, (step + 1) * EPISODES_PER_STEP)):
            one = propose(first_turn + done)
            episode = run_proposal(one, here / LEDGER_FILE, first_turn + done, cache=cache)
            with (here / PROPOSALS_FILE).open("ab") as lines:
                lines.write(encode_samples((one,)))
            on_episode(done + 1, episode)

    return run_steps(folder, -(-number // EPISODES_PER_STEP), fly_some, initial_folder=initial_folder)


def load_proposals(folder: Path) -> tuple[Sample, ...]:
    """The proposals of a folder that `flown` left, by turn."""
    return decode_samples((folder / PROPOSALS_FILE).read_bytes())


def run_proposal(one: Sample, ledger: Path, turn: int, *, cache: Path) -> Episode:
    """Carry out the contract of `one` in its scene, whatever it is, and remember it in `ledger`.

    Its author is the sample's source. Dates are made up, all clocks stand still, and nothing is learnt meanwhile:
    promise: the ledger depends on the proposals and their order alone.
    """
    robot, _, scene = one.scene.partition(" ")
    with tempfile.TemporaryDirectory(prefix="dualbrain-proposal-") as folder:
        config = RunConfig(
            instruction=instruction_of(one),
            out=Path(folder) / memory_id_of_turn(turn),
            ledger=ledger,
            cache=cache,
            robot=robot,
            scene=scene,
            visuals=False,
            seed=turn,
            shots=1,
            static=True,
        )
        dates = count(START_TIME_S + turn * EPISODE_INTERVAL_S, 1.0)
        times = Clocks(lambda: 0.0, START_DATE, lambda: next(dates))
        given = FixedContractPlanner(one.source, one.contract.encode("utf-8", "surrogatepass"))
        with Session(config, times, {}, given) as session:
            return session.run(RunObserver()).episode


def memory_id_of_turn(turn: int) -> str:
    """The name of the memory of a turn."""
    return f"p-{turn}"


def turn_of_memory_id(memory: str) -> int:
    """The turn that a memory of such a ledger is of."""
    return int(memory.removeprefix("p-"))


def build_request(one: Sample, recall: RetrievedContext | None = None) -> PlanRequest:
    """The question of a lesson as the loop asks it, with what was recalled."""
    setting = scene_context_by_name(one.scene)
    registry, names = setting.registry, setting.names
    return PlanRequest(
        instruction=instruction_of(one),
        scene=setting.summary,
        recall=recall or RetrievedContext(),
        robot=registry.robot,
        registry_hash=registry.hash,
        skills_text=describe_skills(registry, names),
        schema=decoding_schema(registry, names),
        contract_id="c-0001",
    )


def instruction_of(one: Sample) -> str:
    """The words of a lesson."""
    found = re.search("<instruction>\n(.*)\n</instruction>", one.prompt[-1]["content"])
    assert found is not None
    return found[1]
