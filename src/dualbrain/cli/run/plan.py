"""dualbrain plan: ask the planner for a contract without moving a robot."""

from __future__ import annotations

import os
import time
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
from cyclopts import Parameter

from dualbrain.cli.common.answer_display import AnswerDisplay
from dualbrain.cli.common.console import StderrConsole, print_result, print_table, sanitize_line
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.graphics import choose_graphics
from dualbrain.cli.common.planner_choice import choose_planner
from dualbrain.cli.common.planner_threads import planner_threads
from dualbrain.cli.common.spinner import Spinner
from dualbrain.core.paths import cache_folder, dualbrain_home
from dualbrain.core.storage.private_files import create_private_folder, open_private_folder
from dualbrain.errors import UsageError

if TYPE_CHECKING:
    from dualbrain.grounding.envelope.robot_at_site import RobotAtSite
    from dualbrain.knowledge.document import ConsultedDocuments
    from dualbrain.planner.camera_image import CameraImage
    from dualbrain.planner.protocol import Planner
    from dualbrain.records import Attempt
    from dualbrain.runtime.inspection.dry_run import DryRunResult
    from dualbrain.runtime.planning.planner_request import PassageRetriever, PlanningContext, Retriever
    from dualbrain.simulation.scenes.scene_spec import SceneSpec

MAX_SHOTS = 5


def plan(
    instruction: str,
    /,
    *,
    robot: str = "panda",
    scene: str = "0",
    planner: str = "",
    memory: Literal["on", "off"] = "on",
    knowledge: Literal["on", "site", "off"] = "site",
    ledger: Path | None = None,
    site: Path | None = None,
    image: Annotated[bool, Parameter(negative="")] = False,
    image_file: Path | None = None,
    shots: int = 2,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Plan one instruction and print every step; no robot moves, and memory is only read.

    Parameters
    ----------
    instruction
        The task in words (English).
    robot
        panda, fr3, ur5e, base or mobile_panda.
    scene
        The scene: a number, FAMILY:SEED or a scene file.
    planner
        A name from `dualbrain models list`, an adapter (`adapter:champion`), a GGUF file, or a server URL. Default: as
        for `dualbrain run`.
    memory
        "off" retrieves no memories.
    knowledge
        Documents whose passages enter the prompt, as for `dualbrain run`: "site", "on" or "off". An adapter reads none.
    ledger
        Memory ledger, read only. Default: ledger.sqlite in the data folder of dualbrain.
    site
        Site file (TOML), as for `dualbrain run`: its limits of the robot and of objects, and its permissions, apply.
    image
        Send the image of the robot's simulated camera to the planner, which must be a server with a vision-language
        model (--planner URL).
    image_file
        Send this image instead: a PNG or JPEG file of at most 320x240 pixels and 40 kB.
    shots
        Number of attempts of the planner, 1 to 5; after a rejection the prompt states the reason.
    json
        Print one JSON object on stdout.
    """
    if not instruction.strip():
        raise UsageError.stating(
            "The instruction is empty.", fix='For example: dualbrain plan "put the red cube in the bowl"'
        )
    if not 1 <= shots <= MAX_SHOTS:
        raise UsageError("--shots", got=shots, allowed=f"1 to {MAX_SHOTS}")
    if image and image_file is not None:
        raise UsageError.stating("--image and --image-file name two images.", fix="Leave out one of them.")
    console = StderrConsole()
    loading = Spinner(console, "loading")
    with ExitStack() as stack:
        stack.enter_context(loading)
        if image:
            choose_graphics(os.environ)  # before MuJoCo is imported
        from dualbrain.grounding.envelope.object_limits import limits_in_words
        from dualbrain.grounding.envelope.robot_at_site import open_robot_at_site
        from dualbrain.grounding.instruction.clauses.clause_classifier import find_clause_classifier
        from dualbrain.grounding.offline_gate import scene_from_spec
        from dualbrain.knowledge.library import has_site_documents
        from dualbrain.planner.introspection import no_documents_reason, require_image_input
        from dualbrain.planner.protocol import show_answers
        from dualbrain.runtime.inspection.dry_run import context_at_home
        from dualbrain.runtime.inspection.dry_run import plan as ask
        from dualbrain.simulation.scenes.generators.catalogue import open_scene

        spec = open_scene(scene, robot)
        at_site = open_robot_at_site(robot, site)
        here = context_at_home(at_site, scene_from_spec(spec))
        if image or image_file is not None:
            here = replace(here, camera_image=_read_image(image_file, spec, here))
        recall = stack.enter_context(_open_memory(ledger, at_site)) if memory == "on" else None
        look_up = _no_documents if knowledge == "off" else stack.enter_context(_open_documents(here, knowledge))
        chosen, notice = choose_planner(planner, here.robot_model.name, cache_folder())
        opened = stack.enter_context(_open_planner(chosen, here, robot))
        if here.camera_image is not None:
            require_image_input(opened)
        loading.stop()
        expected = knowledge == "on" or (knowledge == "site" and has_site_documents(_document_store()))
        documents = no_documents_reason(opened) if expected else ""
        for line in filter(None, (*limits_in_words(here.scene, at_site.object_limits), notice, documents)):
            console.print(line, markup=False)
        with Spinner(console, f"planning ({opened.name})") as waiting:
            show_answers(opened, AnswerDisplay(waiting))
            classifier = find_clause_classifier(cache_folder())
            ask_planner = partial(ask, shots=shots, clock=time.perf_counter, classifier=classifier)
            planned = ask_planner(instruction, at_site, here, opened, recall, look_up)
    if json:
        about = {"image": _describe_image(here.camera_image)} if here.camera_image else {}
        print_result(msgspec.json.encode(plan_summary(instruction, planned) | about).decode())
    else:
        _print_plan(planned, here.camera_image)
    if not planned.has_answer:
        return ExitCode.FAILED_SAFELY
    return ExitCode.REJECTED if planned.is_declined or not _is_accepted(planned) else ExitCode.SUCCESS


def plan_summary(instruction: str, planned: DryRunResult) -> dict[str, Any]:
    """The JSON object that `--json` prints."""
    last = planned.shots[-1].attempt
    return {
        "instruction": instruction,
        "summary": planned.summary,
        "accepted": _is_accepted(planned),
        "declined": planned.is_declined,
        "refusal": planned.refusal,
        "contract": _accepted_contract(planned),
        "verdict": last.verdict,
        "retrieved": planned.recall,
        "unread": planned.unsupported_fields,
        "shots": [{"prompt": one.prompt, **_encode_attempt(one.attempt)} for one in planned.shots],
        "planner": last.proposal.planner,
        "timings": planned.timings,
        "template": planned.template_hash,
    }


def _encode_attempt(attempt: Attempt) -> dict[str, Any]:
    proposal = attempt.proposal
    return {
        "answer": proposal.text,
        "finish_reason": proposal.finish_reason,
        "constrained_by": proposal.constrained_by,
        "timings": proposal.timings,
        "verdict": attempt.verdict,
        "gate_s": attempt.gate_s,
    }


def _describe_image(image: CameraImage) -> dict[str, Any]:
    return {"type": image.media_type, "bytes": len(image.data), "sha256": image.sha256}


def _is_accepted(planned: DryRunResult) -> bool:
    from dualbrain.contracts.verdict import Accepted

    return isinstance(planned.verdict, Accepted)


def _accepted_contract(planned: DryRunResult) -> dict[str, Any] | None:
    from dualbrain.contracts.verdict import Accepted

    verdict = planned.verdict
    return msgspec.to_builtins(verdict.contract) if isinstance(verdict, Accepted) else None


def _print_plan(planned: DryRunResult, image: CameraImage | None) -> None:
    """Print prompt, answer, verdict, retrieved items and times; control characters are removed."""
    from dualbrain.runtime.planning.planning_time import format_timings

    for number, shot in enumerate(planned.shots, start=1):
        head = "prompt" if number == 1 else f"prompt of attempt {number}: last message"
        if not shot.prompt:
            print_result("The planner is not asked: the local layer answers this instruction.")
            print_result(sanitize_line(planned.refusal) or "It is a stop command.")
        print_result(f"── {head} " + "─" * 60)
        for message in shot.prompt if number == 1 else shot.prompt[-1:]:
            print_result(f"[{message['role']}]")
            for line in message["content"].splitlines():
                print_result(sanitize_line(line))
        print_result(f"── answer of {shot.attempt.proposal.planner} " + "─" * 60)
        print_result(sanitize_line(shot.attempt.proposal.text) or "no text")
        for line in _verdict_lines(shot.attempt):
            print_result(line)
    if image is not None:
        about = _describe_image(image)
        print_result("── image " + "─" * 60)
        print_result(f"{about['type']}, {about['bytes']} bytes, SHA-256 {about['sha256']}, sent with every request")
    print_result("── retrieved " + "─" * 60)
    _print_retrieved(planned)
    if words := format_timings(planned.timings):
        print_result("── time " + "─" * 60)
        print_result(words)


def _print_retrieved(planned: DryRunResult) -> None:
    recall = planned.recall
    avoid = "avoid (not in the prompt)" if "warnings" in planned.unsupported_fields else "avoid"
    shown = "passage (not in the prompt of this planner)" if "passages" in planned.unsupported_fields else "passage"
    rows = [
        (
            use,
            str(one.rank),
            f"{one.score:.3f}",
            f"{one.similarity:.3f}",
            f"{one.weight:.3f}",
            one.episode_id,
            one.instruction,
        )
        for use, found in (("follow", recall.exemplars), (avoid, recall.warnings))
        for one in found
    ]
    if rows:
        print_table(("use", "rank", "R", "s", "w", "memory", "instruction"), rows, wrap_columns=("instruction",))
    if recall.passages:
        quoted = [(str(one.rank), one.citation, one.trust, f"{one.likeness:.3f}", one.text) for one in recall.passages]
        print_table(("rank", "citation", "trust", "similarity", shown), quoted, wrap_columns=(shown,))
    if not rows and not recall.passages:
        print_result("nothing")


def _verdict_lines(attempt: Attempt) -> Iterator[str]:
    """The stages of the gate; for a rejection the value found and the values allowed."""
    from dualbrain.contracts.verdict import STAGES, Accepted
    from dualbrain.planner.protocol import describe_failure, has_answer

    verdict = attempt.verdict
    if not has_answer(attempt.proposal):
        yield sanitize_line(f"no answer: {describe_failure(attempt.proposal.finish_reason)}")
        return
    if isinstance(verdict, Accepted):
        yield "accepted: " + ", ".join(f"{stage} ✓" for stage in STAGES)
        return
    passed = [f"{stage} ✓" for stage in STAGES[: STAGES.index(verdict.stage)]]
    yield sanitize_line("rejected: " + ", ".join([*passed, f"{verdict.stage} ✗ at {verdict.pointer or '/'}"]))
    yield sanitize_line(f"got {verdict.got!r}, allowed {verdict.allowed!r}: {verdict.hint}")


# --- image, memory, documents and planner -----------------------------------------------------------------------------


def _read_image(path: Path | None, spec: SceneSpec, here: PlanningContext) -> CameraImage:
    """The image in the file `path`; without one, that of the simulated camera before the robot moves."""
    from dualbrain.planner.camera_image import read_camera_image

    if path is not None:
        return read_camera_image(path)
    from dualbrain.runtime.planning.camera import capture_camera_image
    from dualbrain.simulation.plant.factory import make_plant

    return capture_camera_image(make_plant(spec, here.robot_model, visuals=True))


@contextmanager
def _open_memory(ledger: Path | None, at_site: RobotAtSite) -> Generator[Retriever | None]:
    """The memory, read only; None if no run has written one yet."""
    from dualbrain.cli.memory.open_memory import ledger_path, load_encoder, open_reader
    from dualbrain.memory.config import MemoryConfig
    from dualbrain.memory.embedding.posture_features import PostureLimits
    from dualbrain.memory.memory import Memory

    path = ledger_path(ledger)
    if ledger is None and not path.exists():
        yield None
        return
    with open_reader(path) as opened:
        limits = (PostureLimits.from_model(at_site.model_without_site),)
        yield Memory(opened, load_encoder(), MemoryConfig(limits=limits))


def _document_store() -> Path:
    return dualbrain_home() / "knowledge.sqlite"


@contextmanager
def _open_documents(here: PlanningContext, consult: ConsultedDocuments) -> Generator[PassageRetriever]:
    """The documents, as in a run with the same `--knowledge`."""
    from dualbrain.cli.memory.open_memory import load_encoder
    from dualbrain.grounding.document_retrieval import consulted_budget, retrieve_passages
    from dualbrain.knowledge.builtin_documents import open_library

    path = _document_store()
    if consult == "site" and not path.exists():
        yield _no_documents
        return
    create_private_folder(path.parent)
    library, budget = open_library(path, load_encoder(), now=time.time()), consulted_budget(consult)
    try:
        yield lambda instruction, seen: retrieve_passages(library, instruction, seen, here.registry, budget)
    finally:
        library.close()


@contextmanager
def _open_planner(name: str, here: PlanningContext, robot: str) -> Generator[Planner]:
    from dualbrain.adaptation.serving.open_planner import open_planner
    from dualbrain.contracts.registry import is_narrower
    from dualbrain.robots.loader import load_robot
    from dualbrain.skills.registry import skill_registry

    registry, own = here.registry, skill_registry(load_robot(robot))
    prefixes = cache_folder() / "prefixes"
    open_private_folder(prefixes)
    opened = open_planner(
        name,
        cache_folder(),
        adapters=dualbrain_home() / "adapters",
        robot=here.robot_model.name,
        registry=registry.hash,
        key=os.environ.get("OPENAI_API_KEY", ""),
        threads=planner_threads(control_loop=False),
        prompt_cache=prefixes,
        narrowed_registries={registry.hash: own.hash} if is_narrower(registry, own) else {},
    )
    try:
        yield opened
    finally:
        opened.close()


def _no_documents(instruction: str, seen: str) -> tuple[()]:
    del instruction, seen
    return ()
