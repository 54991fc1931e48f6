"""dualbrain adapters measure: a candidate and the champion asked the same held-out questions, for the gate."""

from __future__ import annotations

from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter

from dualbrain.cli.adapters.registry import registry_of_adapters
from dualbrain.cli.common.console import Account
from dualbrain.cli.common.exit_codes import Exit
from dualbrain.cli.common.paths import cache
from dualbrain.cli.memory.open_memory import ledger_path, reader, tell
from dualbrain.errors import InvalidSetup, MissingPart

if TYPE_CHECKING:
    from dualbrain.adaptation.adapters.registry import Adapters
    from dualbrain.adaptation.adapters.stacking import Stack
    from dualbrain.memory.ledger.ledger import LedgerReader

Flag = Annotated[bool, Parameter(negative="")]


def measure(
    name: str, /, *, data: Path, out: Path, most: int = 0, fly: bool = True, ledger: Path | None = None,
    seed: int = 0, threads: int = 1, json: Flag = False,
) -> int:  # fmt: skip
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
    from dualbrain.adaptation.adapters.compatibility import require_fit, require_prompt
    from dualbrain.adaptation.adapters.naming import champion_at
    from dualbrain.adaptation.adapters.promotion import Measured
    from dualbrain.adaptation.adapters.registry import BARE, place_of
    from dualbrain.adaptation.adapters.stacking import stack_of
    from dualbrain.adaptation.adapters.training_overlap import unseen
    from dualbrain.adaptation.curation.dataset import read_dataset
    from dualbrain.adaptation.serving.measurement import of_robot, questions
    from dualbrain.core.storage.atomic_files import require_place, write_durably
    from dualbrain.grounding.vocabulary import vocabulary

    registry, dataset = registry_of_adapters(), read_dataset(data)
    stack = stack_of(_candidate(name, registry), cache())
    vocabulary_here = vocabulary(stack.top.robot)
    require_prompt(stack.top)
    require_fit(stack.top, stack.top.robot, vocabulary_here.hash)
    champion = registry.champion(place_of(stack.top))
    if stack.top.id == champion:
        raise _no_candidate()
    present = stack_of(champion_at(registry, champion), cache()) if champion != BARE else stack.below
    with ExitStack() as opened:
        remembered = opened.enter_context(_remembered(ledger)) if fly or ledger else None
        apart = of_robot(dataset.held_out, stack.top.robot)
        kept = unseen(apart, [layer.card for layer in (*stack.layers, *present.layers)], dataset, remembered)
        if len(kept) < len(apart):
            Account().print(f"left out: {len(apart) - len(kept)} questions that one of the two was taught")
        asked, flight = questions(kept, most), None
        if fly and remembered:
            from dualbrain.runtime.memory_replay import remembered_flight

            flight = remembered_flight(remembered, asked, seed=seed)
        require_place(out)
        results = [
            _results(one, who, asked, vocabulary_here, flight, threads)
            for one, who in ((stack, stack.top.id), (present, champion))
        ]
    measured = Measured(*results, dataset=dataset.card.hash)
    write_durably(out, msgspec.json.format(msgspec.json.encode(measured), indent=2))
    if json:
        tell(measured)
    Account().print(f"written: {out}" if fly else f"written: {out}; not flown, so nothing can be promoted by it")
    return Exit.SUCCESS


def _candidate(name: str, registry: Adapters) -> Path:
    """The folder of the adapter to measure; raises `InvalidSetup` where `name` means who serves."""
    from dualbrain.adaptation.adapters.naming import CHAMPION, PREFIX, folder_of

    if name.removeprefix(PREFIX) == CHAMPION:
        raise _no_candidate()
    return folder_of(name, registry)


def _remembered(ledger: Path | None) -> AbstractContextManager[LedgerReader]:
    """The memory that the data set was made of; raises `MissingPart` if it is not there."""
    if not (path := ledger_path(ledger)).exists():
        fix = "Name the one that the data set was made of with --ledger, or leave the flights out with --no-fly."
        raise MissingPart(f"The memory ledger {path}", fix=fix)
    return reader(ledger)


def _no_candidate() -> InvalidSetup:
    fix = "To measure it anew, roll it back first: `dualbrain adapters rollback`."
    return InvalidSetup("candidate", got="the champion itself", allowed="another adapter", fix=fix)


def _results(stack: Stack, who: str, asked: Any, registry: Any, flight: Any, threads: int) -> Any:
    """What one of the two did."""
    from dualbrain.adaptation.serving.measurement import measure as ask
    from dualbrain.adaptation.serving.open_planner import N_CTX, wear
    from dualbrain.adaptation.serving.raw_completion import runtime_of
    from dualbrain.planner.backends.llama_cpp import LlamaConfig
    from dualbrain.planner.prompt.prompt_format import FREE

    account, short = Account(), who[:16] or "the bare base"
    planner = wear(stack, cache(), LlamaConfig(threads=threads, n_ctx=N_CTX), called=short, asking=FREE)
    try:
        found = ask(
            planner, asked, registry, adapter=who, runtime=runtime_of(planner.model), fly=flight,
            tell=lambda done, of, trial: account.print(f"{short} {done}/{of}: {_word(trial)}"),
        )  # fmt: skip
    finally:
        planner.close()
    rows = found.trials
    account.print(
        f"{short}: {sum(r.compliant for r in rows)} of {len(rows)} compliant, {sum(r.right for r in rows)} right, "
        f"perplexity {found.perplexity:.2f}"
    )
    return found


def _word(trial: Any) -> str:
    words = "right" if trial.right else "compliant" if trial.compliant else "not compliant"
    return words if trial.success is None else f"{words}, {'success' if trial.success else 'no success'}"
