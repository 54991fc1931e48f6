"""dualbrain adapters measure: a candidate and the champion asked the same held-out questions, for the gate."""

from __future__ import annotations

from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter

from dualbrain.cli.adapters.registry import open_adapter_registry
from dualbrain.cli.common.console import StderrConsole
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.paths import cache_folder
from dualbrain.cli.memory.open_memory import ledger_path, open_reader, print_json
from dualbrain.errors import ConfigurationError, MissingDependencyError

if TYPE_CHECKING:
    from dualbrain.adaptation.adapters.registry import AdapterRegistry
    from dualbrain.adaptation.adapters.stacking import AdapterStack
    from dualbrain.memory.ledger.ledger import LedgerReader

Flag = Annotated[bool, Parameter(negative="")]


def measure(
    name: str,
    /,
    *,
    data: Path,
    out: Path,
    most: int = 0,
    fly: bool = True,
    ledger: Path | None = None,
    seed: int = 0,
    threads: int = 1,
    json: Flag = False,
) -> int:
    """Ask an adapter and the present champion the same held-out questions, and write what the gate wants to know.

    Both answer freely, in the runtime that serves: no grammar, no schema, no examples. What they answer is carried out
    in simulation. Questions that one of them is known to have been taught are left out. Then
    `dualbrain adapters promote NAME --measured OUT`.

    Parameters
    ----------
    name
        The candidate: the beginning of its id, the name of one that comes with dualbrain, or a folder that a fit left.
    data
        A data set, as `dualbrain adapt --export` writes it or a fit leaves it; its held-out part is asked.
    out
        The file that the results go to; its folder is made.
    most
        Ask at most so many questions, evenly chosen; 0 means all.
    fly
        Carry each contract out in simulation, in the world its memory was made in: success and Δ in closed loop. With
        --no-fly only the words are judged, and nothing is promoted by that.
    ledger
        The memory that the data set was made of; default in dualbrain's home. Without it nothing can be flown.
    seed
        Everything random in these worlds.
    threads
        Processor threads of the model; more than one only on an idle machine.
    json
        Print the results as one JSON object on stdout.
    """
    from dualbrain.adaptation.adapters.compatibility import require_compatible, require_same_prompt
    from dualbrain.adaptation.adapters.naming import champion_folder
    from dualbrain.adaptation.adapters.promotion import Measurement
    from dualbrain.adaptation.adapters.registry import NO_ADAPTER, place_of_card
    from dualbrain.adaptation.adapters.stacking import load_stack
    from dualbrain.adaptation.adapters.training_overlap import unseen_samples
    from dualbrain.adaptation.curation.dataset import read_dataset
    from dualbrain.adaptation.serving.measurement import samples_for_robot, select_questions
    from dualbrain.core.storage.atomic_files import require_writable, write_atomically
    from dualbrain.grounding.vocabulary import load_skill_registry

    registry, dataset = open_adapter_registry(), read_dataset(data)
    stack = load_stack(_candidate(name, registry), cache_folder())
    vocabulary_here = load_skill_registry(stack.top_card.robot)
    require_same_prompt(stack.top_card)
    require_compatible(stack.top_card, stack.top_card.robot, vocabulary_here.hash)
    champion = registry.champion(place_of_card(stack.top_card))
    if stack.top_card.id == champion:
        raise _champion_as_candidate_error()
    present = (
        load_stack(champion_folder(registry, champion), cache_folder()) if champion != NO_ADAPTER else stack.without_top
    )
    with ExitStack() as opened:
        remembered = opened.enter_context(_open_source_ledger(ledger)) if fly or ledger else None
        apart = samples_for_robot(dataset.held_out, stack.top_card.robot)
        kept = unseen_samples(apart, [layer.card for layer in (*stack.layers, *present.layers)], dataset, remembered)
        if len(kept) < len(apart):
            StderrConsole().print(f"left out: {len(apart) - len(kept)} questions that one of the two was taught")
        asked, flight = select_questions(kept, most), None
        if fly and remembered:
            from dualbrain.runtime.inspection.memory_replay import make_replay_evaluator

            flight = make_replay_evaluator(remembered, asked, seed=seed)
        require_writable(out)
        results = [
            _measure_adapter(one, who, asked, vocabulary_here, flight, threads)
            for one, who in ((stack, stack.top_card.id), (present, champion))
        ]
    measured = Measurement(*results, dataset=dataset.card.hash)
    write_atomically(out, msgspec.json.format(msgspec.json.encode(measured), indent=2))
    if json:
        print_json(measured)
    StderrConsole().print(f"written: {out}" if fly else f"written: {out}; not flown, so nothing can be promoted by it")
    return ExitCode.SUCCESS


def _candidate(name: str, registry: AdapterRegistry) -> Path:
    """The folder of the adapter to measure; raises `InvalidSetup` where `name` means who serves."""
    from dualbrain.adaptation.adapters.naming import ADAPTER_PREFIX, CHAMPION, resolve_folder

    if name.removeprefix(ADAPTER_PREFIX) == CHAMPION:
        raise _champion_as_candidate_error()
    return resolve_folder(name, registry)


def _open_source_ledger(ledger: Path | None) -> AbstractContextManager[LedgerReader]:
    """The memory that the data set was made of; raises `MissingPart` if it is not there."""
    if not (path := ledger_path(ledger)).exists():
        fix = "Name the one that the data set was made of with --ledger, or leave the flights out with --no-fly."
        raise MissingDependencyError(f"The memory ledger {path}", fix=fix)
    return open_reader(ledger)


def _champion_as_candidate_error() -> ConfigurationError:
    fix = "To measure it anew, roll it back first: `dualbrain adapters rollback`."
    return ConfigurationError("candidate", got="the champion itself", allowed="another adapter", fix=fix)


def _measure_adapter(stack: AdapterStack, who: str, asked: Any, registry: Any, flight: Any, threads: int) -> Any:
    """What one of the two did."""
    from dualbrain.adaptation.serving.measurement import measure_planner as ask
    from dualbrain.adaptation.serving.open_planner import N_CTX, start_llama
    from dualbrain.adaptation.serving.raw_completion import runtime_name
    from dualbrain.planner.backends.llama_cpp import LlamaConfig
    from dualbrain.planner.prompt.prompt_format import UNCONSTRAINED_SHORT_PROMPT

    account, short = StderrConsole(), who[:16] or "the bare base"
    planner = start_llama(
        stack,
        cache_folder(),
        LlamaConfig(threads=threads, n_ctx=N_CTX),
        name=short,
        prompt_format=UNCONSTRAINED_SHORT_PROMPT,
    )
    try:
        found = ask(
            planner,
            asked,
            registry,
            adapter=who,
            runtime=runtime_name(planner.model),
            execute=flight,
            report=lambda done, of, trial: account.print(f"{short} {done}/{of}: {_describe_trial(trial)}"),
        )
    finally:
        planner.close()
    rows = found.trials
    account.print(
        f"{short}: {sum(r.compliant for r in rows)} of {len(rows)} compliant, {sum(r.right for r in rows)} right, "
        f"perplexity {found.perplexity:.2f}"
    )
    return found


def _describe_trial(trial: Any) -> str:
    words = "right" if trial.right else "compliant" if trial.compliant else "not compliant"
    return words if trial.success is None else f"{words}, {'success' if trial.success else 'no success'}"
