"""`dualbrain adapters measure`: candidate and champion on the same held-out questions, for the promotion gate."""

from __future__ import annotations

from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter

from dualbrain.cli.adapters.registry import open_adapter_registry
from dualbrain.cli.common.arguments import Seed
from dualbrain.cli.common.console import StderrConsole
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.memory.open_memory import ledger_path, open_reader, print_json
from dualbrain.core.paths import cache_folder
from dualbrain.errors import ConfigurationError, MissingDependencyError

if TYPE_CHECKING:
    from dualbrain.adaptation.adapters.registry import AdapterRegistry
    from dualbrain.adaptation.adapters.stacking import AdapterStack
    from dualbrain.memory.ledger.ledger import LedgerReader

Flag = Annotated[bool, Parameter(negative="")]
HiddenDefault = Annotated[int, Parameter(show_default=False)]
"""A number whose default 0 has the meaning that its help states."""


def measure(
    name: str,
    /,
    *,
    data: Path,
    out: Path,
    most: HiddenDefault = 0,
    fly: bool = True,
    ledger: Path | None = None,
    seed: Seed = 0,
    threads: int = 1,
    json: Flag = False,
) -> int:
    """Ask an adapter and the present champion the same held-out questions and write the results for the promotion gate.

    Both answer without constraints in the serving runtime: no grammar, no schema, no exemplars. Their contracts are
    executed in simulation. Questions from the known training data of either adapter are left out. The next command is
    `dualbrain adapters promote NAME --measured OUT`.

    Parameters
    ----------
    name
        The candidate: the beginning of an id, the name of a packaged adapter, or a folder that training wrote.
    data
        A data set from `dualbrain adapt --export` or from a training run; its held-out part is used.
    out
        The file for the results; its folder is created.
    most
        Maximum number of questions, evenly chosen; 0 means all.
    fly
        Execute each contract in simulation, in the scene of its memory: success and Δ in closed loop. With --no-fly
        only the answers are scored, and the results cannot justify a promotion.
    ledger
        The memory ledger that the data set was made from; default in dualbrain's home. Execution needs it, except for
        the data set of an exploration, whose questions name generated scenes.
    seed
        Seed of all randomness in the simulation.
    threads
        Number of processor threads of the model; use more than one only on an idle machine.
    json
        Print the results as one JSON object on stdout.
    """
    from dualbrain.adaptation.adapters.compatibility import require_compatible, require_same_prompt
    from dualbrain.adaptation.adapters.naming import champion_folder
    from dualbrain.adaptation.adapters.promotion import Measurement
    from dualbrain.adaptation.adapters.registry import NO_ADAPTER, place_of_card
    from dualbrain.adaptation.adapters.stacking import load_stack
    from dualbrain.adaptation.adapters.training_overlap import unseen_samples
    from dualbrain.adaptation.curation.dataset import read_dataset, require_questions_for
    from dualbrain.adaptation.serving.measurement import samples_for_robot, select_questions
    from dualbrain.core.storage.atomic_files import require_writable, write_atomically
    from dualbrain.grounding.vocabulary import load_skill_registry
    from dualbrain.robots.loader import load_builtin_robot

    registry, dataset = open_adapter_registry(), read_dataset(data)
    stack = load_stack(_candidate(name, registry), cache_folder())
    vocabulary = load_skill_registry(load_builtin_robot(stack.top_card.robot).name)
    require_same_prompt(stack.top_card)
    require_compatible(stack.top_card, stack.top_card.robot, vocabulary.hash)
    champion = registry.champion(place_of_card(stack.top_card))
    if stack.top_card.id == champion:
        raise _champion_as_candidate_error()
    serving = (
        load_stack(champion_folder(registry, champion), cache_folder()) if champion != NO_ADAPTER else stack.without_top
    )
    require_questions_for(dataset.card, stack.top_card.robot, vocabulary.hash)
    from dualbrain.runtime.data_collection.exploration.held_out import has_generated_scenes

    generated = has_generated_scenes(dataset.card)
    with ExitStack() as opened:
        needs_ledger = ledger or (fly and not generated)
        ledger_reader = opened.enter_context(_open_source_ledger(ledger)) if needs_ledger else None
        held_out = samples_for_robot(dataset.held_out, stack.top_card.robot)
        unseen = unseen_samples(
            held_out, [layer.card for layer in (*stack.layers, *serving.layers)], dataset, ledger_reader
        )
        if len(unseen) < len(held_out):
            left_out = len(held_out) - len(unseen)
            StderrConsole().print(f"left out: {left_out} questions from the training data of one of the two")
        questions, execute = select_questions(unseen, most), None
        if fly and generated:
            from dualbrain.runtime.data_collection.exploration.held_out import make_scene_evaluator

            execute = make_scene_evaluator(seed, cache_folder())
        elif fly and ledger_reader:
            from dualbrain.runtime.inspection.memory_replay import make_replay_evaluator

            execute = make_replay_evaluator(ledger_reader, questions, seed=seed)
        require_writable(out)
        results = [
            _measure_adapter(
                one, adapter_id, _as_read_by(one, questions, generated=generated), vocabulary, execute, threads
            )
            for one, adapter_id in ((stack, stack.top_card.id), (serving, champion))
        ]
    measured = Measurement(*results, dataset=dataset.card.hash)
    write_atomically(out, msgspec.json.format(msgspec.json.encode(measured), indent=2))
    if json:
        print_json(measured)
    StderrConsole().print(
        f"written: {out}" if fly else f"written: {out}; without execution, so it cannot justify a promotion",
        markup=False,
    )
    return ExitCode.SUCCESS


def _as_read_by(stack: AdapterStack, questions: Any, *, generated: bool) -> Any:
    """The questions of an exploration as the planner `stack` serves: with fitting values if it was trained so."""
    from dualbrain.runtime.data_collection.exploration.held_out import without_values

    has_values = bool(stack.layers) and stack.top_card.scene_values
    return tuple(map(without_values, questions)) if generated and not has_values else questions


def _candidate(name: str, registry: AdapterRegistry) -> Path:
    """The folder of the adapter to measure; raises `ConfigurationError` if `name` is the champion."""
    from dualbrain.adaptation.adapters.naming import ADAPTER_PREFIX, CHAMPION, resolve_folder

    if name.removeprefix(ADAPTER_PREFIX) == CHAMPION:
        raise _champion_as_candidate_error()
    return resolve_folder(name, registry)


def _open_source_ledger(ledger: Path | None) -> AbstractContextManager[LedgerReader]:
    """The ledger that the data set was made from; raises `MissingDependencyError` if it does not exist."""
    if not (path := ledger_path(ledger)).exists():
        fix = "Name the ledger of the data set with --ledger, or measure without execution by --no-fly."
        raise MissingDependencyError(f"The memory ledger {path}", fix=fix)
    return open_reader(ledger)


def _champion_as_candidate_error() -> ConfigurationError:
    fix = "Name another adapter, or roll it back before with `dualbrain adapters rollback`."
    return ConfigurationError.stating("The candidate is the champion itself.", fix=fix)


def _measure_adapter(
    stack: AdapterStack, adapter_id: str, questions: Any, registry: Any, execute: Any, threads: int
) -> Any:
    """The results of one of the two planners."""
    from dualbrain.adaptation.serving.measurement import measure_planner
    from dualbrain.adaptation.serving.open_planner import N_CTX, start_llama
    from dualbrain.adaptation.serving.raw_completion import runtime_name
    from dualbrain.planner.backends.llama_cpp import LlamaConfig
    from dualbrain.planner.prompt.prompt_format import UNCONSTRAINED_SHORT_PROMPT

    console, label = StderrConsole(), adapter_id[:16] or "the bare base"
    planner = start_llama(
        stack,
        cache_folder(),
        LlamaConfig(threads=threads, n_ctx=N_CTX),
        name=label,
        prompt_format=UNCONSTRAINED_SHORT_PROMPT,
    )
    try:
        found = measure_planner(
            planner,
            questions,
            registry,
            adapter=adapter_id,
            runtime=runtime_name(planner.model),
            execute=execute,
            report=lambda done, of, trial: console.print(
                f"{label} {done}/{of}: {_describe_trial(trial)}", markup=False
            ),
        )
    finally:
        planner.close()
    rows = found.trials
    console.print(
        f"{label}: {sum(r.compliant for r in rows)} of {len(rows)} compliant, {sum(r.right for r in rows)} right, "
        f"perplexity {found.perplexity:.2f}",
        markup=False,
    )
    return found


def _describe_trial(trial: Any) -> str:
    words = "right" if trial.right else "compliant" if trial.compliant else "not compliant"
    return words if trial.success is None else f"{words}, {'success' if trial.success else 'no success'}"
