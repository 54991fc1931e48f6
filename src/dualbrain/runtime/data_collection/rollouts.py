"""Rollouts: proposed contracts are executed in their scenes with the filter on, and stored in a ledger.

`draw_proposals` draws contracts by seed, with random valid parameters: there is no planner, and nothing is selected by
its outcome. Any other proposal is a synthetic example with another contract and another source.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable
from itertools import count
from pathlib import Path

from dualbrain.adaptation.curation.sample import Sample, decode_samples, encode_samples
from dualbrain.contracts.schema import describe_skills
from dualbrain.core.storage.private_files import open_private
from dualbrain.core.storage.resumable_steps import run_steps
from dualbrain.planner.request import PlanRequest
from dualbrain.planner.scripted import FixedContractPlanner
from dualbrain.records import Episode, RetrievedContext
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples, scene_context_by_name
from dualbrain.runtime.planning.planner_request import answer_schema
from dualbrain.runtime.session import Clocks, RunConfig, RunObserver, Session

ROBOT = "panda"
LEDGER_FILE, PROPOSALS_FILE = "ledger.sqlite", "proposals.jsonl"
EPISODES_PER_STEP = 10
"""Episodes of one resumable step."""
FIRST_SEED = 1000
"""First seed of the draws; the seeds of the training set of base-135m are smaller."""
EPSILON = 0.0021
"""Intervention threshold ε of training episodes of a Panda: that of its memory in suite `paper`, from its pilot."""
START_DATE, START_TIME_S, EPISODE_INTERVAL_S = "2026-11-21T00:00:00+00:00", 1_795_000_000.0, 240.0
"""Fixed date of the start, also in [s, 1970 UTC], and time between two episodes [s]."""


def draw_proposals(seed: int, number: int, *, include_declines: bool = False) -> tuple[Sample, ...]:
    """`number` proposals without exemplars, for feasible instructions.

    With `include_declines`, the proposals also decline infeasible instructions, in the proportion of synthetic
    examples.
    """
    examples = generate_examples(
        number if include_declines else 2 * number, "teach", FIRST_SEED + seed, {ROBOT: 1.0}, exemplar_share=0.0
    )
    return tuple(one for one in examples if include_declines or not is_declined(one))[:number]


def is_declined(sample: Sample) -> bool:
    """Whether the contract of a sample declines the instruction."""
    return '"skill":"decline"' in sample.contract


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
    """The folder with the ledger of `number` executed proposals, and with the proposals themselves.

    `propose(turn)` is called from turn `first_turn` on. The work begins with the content of `initial_folder`, another
    such folder. After any interruption, the same call continues and ends with the same ledger. `on_episode` gets the
    number of finished episodes and the last one.
    """

    def run_step(step: int, step_folder: Path) -> None:
        for done in range(step * EPISODES_PER_STEP, min(number, (step + 1) * EPISODES_PER_STEP)):
            one = propose(first_turn + done)
            episode = run_proposal(one, step_folder / LEDGER_FILE, first_turn + done, cache=cache)
            with open_private(step_folder / PROPOSALS_FILE, "ab") as lines:
                lines.write(encode_samples((one,)))
            on_episode(done + 1, episode)

    return run_steps(folder, -(-number // EPISODES_PER_STEP), run_step, initial_folder=initial_folder)


def load_proposals(folder: Path) -> tuple[Sample, ...]:
    """The proposals in a folder of `run_proposals`, by turn."""
    return decode_samples((folder / PROPOSALS_FILE).read_bytes())


def run_proposal(one: Sample, ledger: Path, turn: int, *, cache: Path) -> Episode:
    """Execute the contract of `one` in its scene and store the episode in `ledger`.

    The planner's name is the sample's source. Dates are fixed, all clocks are stopped, and no weight is updated.
    Promise: the ledger depends only on the proposals and their order.
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
        clocks = Clocks(lambda: 0.0, START_DATE, lambda: next(dates))
        planner = FixedContractPlanner(one.source, one.contract.encode("utf-8", "surrogatepass"))
        with Session(config, clocks, {}, planner) as session:
            return session.run(RunObserver()).episode


def memory_id_of_turn(turn: int) -> str:
    """The id of the memory of a turn."""
    return f"p-{turn}"


def turn_of_memory_id(memory: str) -> int:
    """The turn of a memory id."""
    return int(memory.removeprefix("p-"))


def build_request(one: Sample, recall: RetrievedContext | None = None) -> PlanRequest:
    """The request of a sample as the episode loop makes it, with retrieved context; no reach in the schema."""
    context = scene_context_by_name(one.scene)
    registry, instruction = context.registry, instruction_of(one)
    return PlanRequest(
        instruction=instruction,
        scene=context.summary,
        recall=recall or RetrievedContext(),
        robot=registry.robot,
        registry_hash=registry.hash,
        skills_text=describe_skills(registry, context.names),
        schema=answer_schema(instruction, context.perceived, registry, None),
        contract_id="c-0001",
        scene_with_values=context.summary_with_values,
    )


def instruction_of(one: Sample) -> str:
    """The instruction of a sample."""
    found = re.search("<instruction>\n(.*)\n</instruction>", one.prompt[-1]["content"])
    assert found is not None
    return found[1]
