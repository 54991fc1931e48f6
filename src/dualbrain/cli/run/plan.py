"""dualbrain plan: what the planner would be asked, what it answers, what the gate says of it; nothing moves."""

from __future__ import annotations

import os
import time
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from cyclopts import Parameter

from dualbrain.cli.common.console import Account, answer, listing, plain
from dualbrain.cli.common.exit_codes import Exit
from dualbrain.cli.common.paths import cache, home
from dualbrain.cli.run.run import PLANNER
from dualbrain.errors import WrongUsage

if TYPE_CHECKING:
    from dualbrain.planner.protocol import Planner
    from dualbrain.runtime.dry_run import Planned
    from dualbrain.runtime.planner_request import LookUp, Reminder, Standpoint

MOST_SHOTS = 5


def plan(
    instruction: str,
    /,
    *,
    robot: str = "panda",
    scene: str = "0",
    planner: str = PLANNER,
    memory: Literal["on", "off"] = "on",
    knowledge: Literal["on", "off"] = "on",
    ledger: Path | None = None,
    shots: int = 2,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Plan one instruction and show everything; no robot, no simulation, and memory is only read.

    Parameters
    ----------
    instruction
        What to do, in words.
    robot
        Which body.
    scene
        Which world the robot would see: a number, FAMILY:SEED or a scene file.
    planner
        Name from `dualbrain models list`, an adapter (`adapter:champion`), a GGUF file, or a server's URL.
    memory
        "off" recalls nothing.
    knowledge
        "off" consults no documents, as `dualbrain run` does unless told otherwise. An adapted planner reads none.
    ledger
        Which memory; default in dualbrain's home. It is only read.
    shots
        How often the planner may be asked, 1 to 5: after a refusal again, with the refusal in the prompt.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.cli.common.spinner import Waiting
    from dualbrain.grounding.offline_gate import as_specified
    from dualbrain.planner.introspection import deaf_to_documents
    from dualbrain.runtime.dry_run import from_home
    from dualbrain.runtime.dry_run import plan as ask
    from dualbrain.simulation.scenes.generators.catalogue import open_scene

    if not instruction.strip() or not 1 <= shots <= MOST_SHOTS:
        raise WrongUsage(
            "instruction and --shots", got=(instruction, shots), allowed=f"some words, and 1 to {MOST_SHOTS}"
        )
    console = Account()
    here = from_home(robot, as_specified(open_scene(scene, robot)))
    with ExitStack() as stack:
        reminder = stack.enter_context(_memory(ledger, here)) if memory == "on" else None
        look_up = stack.enter_context(_documents(here)) if knowledge == "on" else _nothing
        thinker = stack.enter_context(_planner(planner, here))
        if knowledge == "on" and (why := deaf_to_documents(thinker)):
            console.print(why, markup=False)
        waiting = Waiting(console, f"the planner thinks ({thinker.name})")
        waiting.start()
        try:
            planned = ask(instruction, here, thinker, reminder, look_up, shots=shots, clock=time.perf_counter)
        finally:
            waiting.stop()
    if json:
        answer(msgspec.json.encode(summary(instruction, planned)).decode())
    else:
        _tell(planned)
    if not planned.answered:
        return Exit.FAILED_SAFELY
    return Exit.REJECTED if planned.declined or not _accepted(planned) else Exit.SUCCESS


def summary(instruction: str, planned: Planned) -> dict[str, Any]:
    """The one object that `--json` prints."""
    last = planned.shots[-1].attempt
    return {
        "instruction": instruction, "summary": planned.summary, "accepted": _accepted(planned),
        "declined": planned.declined, "contract": _contract(planned), "verdict": last.verdict,
        "retrieved": planned.recall, "unread": planned.unread,
        "shots": [{"prompt": one.prompt, **_told(one.attempt)} for one in planned.shots],
        "planner": last.proposal.planner, "timings": planned.timings, "template": planned.template,
    }  # fmt: skip


def _told(attempt: Any) -> dict[str, Any]:
    proposal = attempt.proposal
    return {
        "answer": proposal.text, "finish_reason": proposal.finish_reason, "constrained_by": proposal.constrained_by,
        "timings": proposal.timings, "verdict": attempt.verdict, "gate_s": attempt.gate_s,
    }  # fmt: skip


def _accepted(planned: Planned) -> bool:
    from dualbrain.contracts.verdict import Accepted

    return isinstance(planned.verdict, Accepted)


def _contract(planned: Planned) -> dict[str, Any] | None:
    from dualbrain.contracts.verdict import Accepted

    verdict = planned.verdict
    return msgspec.to_builtins(verdict.contract) if isinstance(verdict, Accepted) else None


def _tell(planned: Planned) -> None:
    """For people: prompt, retrieved, contract, verdict, time; text of models and documents cannot steer a terminal."""
    from dualbrain.runtime.planning_time import in_words

    for number, shot in enumerate(planned.shots, start=1):
        head = "prompt" if number == 1 else f"prompt of shot {number}: the last message"
        answer(f"── {head} " + "─" * 60)
        for message in shot.prompt if number == 1 else shot.prompt[-1:]:
            answer(f"[{message['role']}]")
            for line in message["content"].splitlines():
                answer(plain(line))
        answer(f"── answer of {shot.attempt.proposal.planner} " + "─" * 60)
        answer(plain(shot.attempt.proposal.text) or f"none: {shot.attempt.proposal.finish_reason}")
        for line in _verdict(shot.attempt.verdict):
            answer(line)
    answer("── retrieved " + "─" * 60)
    _tell_retrieved(planned)
    if words := in_words(planned.timings):
        answer("── time " + "─" * 60)
        answer(words)


def _tell_retrieved(planned: Planned) -> None:
    recall = planned.recall
    avoid = "avoid, not shown" if "warnings" in planned.unread else "avoid"
    shown = "what was found, not shown to this planner" if "passages" in planned.unread else "what was shown"
    rows = [
        (use, str(one.rank), f"{one.score:.3f}", f"{one.similarity:.3f}", f"{one.weight:.3f}", one.episode_id,
         one.instruction)
        for use, found in (("follow", recall.exemplars), (avoid, recall.warnings)) for one in found
    ]  # fmt: skip
    if rows:
        listing(("use", "rank", "R", "s", "w", "memory", "instruction"), rows, gives=("instruction",))
    if recall.passages:
        quoted = [(str(one.rank), one.citation, one.trust, f"{one.likeness:.3f}", one.text) for one in recall.passages]
        listing(("rank", "citation", "trust", "likeness", shown), quoted, gives=(shown,))
    if not rows and not recall.passages:
        answer("nothing")


def _verdict(verdict: Any) -> Iterator[str]:
    """The gate's stages, the one that refused with what would be allowed."""
    from dualbrain.contracts.verdict import Accepted
    from dualbrain.runtime.episode import STAGES

    if isinstance(verdict, Accepted):
        yield "accepted: " + ", ".join(f"{stage} ✓" for stage in STAGES)
        return
    passed = [f"{stage} ✓" for stage in STAGES[: STAGES.index(verdict.stage)]]
    yield plain("rejected: " + ", ".join([*passed, f"{verdict.stage} ✗ at {verdict.pointer or '/'}"]))
    yield plain(f"got {verdict.got!r}, allowed {verdict.allowed!r}: {verdict.hint}")


# --- what a plan is made from -----------------------------------------------------------------------------------------


@contextmanager
def _memory(ledger: Path | None, here: Standpoint) -> Generator[Reminder | None]:
    """Memory for reading; none where no run has written one yet."""
    from dualbrain.cli.memory.open_memory import encoder, ledger_path
    from dualbrain.memory.config import MemoryConfig
    from dualbrain.memory.embedding.posture_features import PostureLimits
    from dualbrain.memory.ledger.ledger import LedgerReader
    from dualbrain.memory.memory import Memory

    path = ledger_path(ledger)
    if ledger is None and not path.exists():
        yield None
        return
    with LedgerReader(path) as opened:
        yield Memory(opened, encoder(), MemoryConfig((PostureLimits.of(here.body),)))


@contextmanager
def _documents(here: Standpoint) -> Generator[LookUp]:
    """The documents, as a run with `--knowledge on` asks them."""
    from dualbrain.cli.memory.open_memory import encoder
    from dualbrain.grounding.document_retrieval import consult
    from dualbrain.knowledge.builtin_documents import open_library

    path = home() / "knowledge.sqlite"
    path.parent.mkdir(parents=True, exist_ok=True)
    library = open_library(path, encoder(), now=time.time())
    try:
        yield lambda instruction, seen: consult(library, instruction, seen, here.registry)
    finally:
        library.close()


@contextmanager
def _planner(name: str, here: Standpoint) -> Generator[Planner]:
    from dualbrain.adaptation.serving.open_planner import open_planner

    prefixes = cache() / "prefixes"
    prefixes.mkdir(parents=True, exist_ok=True)
    opened = open_planner(
        name, cache(), adapters=home() / "adapters", robot=here.body.name, registry=here.registry.hash,
        key=os.environ.get("OPENAI_API_KEY", ""), prefixes=prefixes,
    )  # fmt: skip
    try:
        yield opened
    finally:
        opened.close()


def _nothing(instruction: str, seen: str) -> tuple[()]:
    del instruction, seen
    return ()
