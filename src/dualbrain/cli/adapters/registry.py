"""dualbrain adapters: what was fitted, which one serves, and changing that by measurement only."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter, validators

from dualbrain.cli.common.console import Account, answer, listing
from dualbrain.cli.common.exit_codes import Exit
from dualbrain.cli.common.paths import cache, home
from dualbrain.cli.memory.open_memory import tell
from dualbrain.cli.run.run import PLANNER
from dualbrain.errors import UNREADABLE, DualbrainError, InvalidSetup

if TYPE_CHECKING:
    from dualbrain.adaptation.adapters.registry import Adapters

Flag = Annotated[bool, Parameter(negative="")]
Count = Annotated[int, Parameter(validator=validators.Number(gte=0))]
MAKE = "`dualbrain adapt` makes them, of what went well"
HEARD = 10
"""Whole answers in the shadow before a promotion: enough to see that it answers what is really asked; no measure."""


def registry_of_adapters() -> Adapters:
    """The registry in dualbrain's home."""
    from dualbrain.adaptation.adapters.registry import Adapters

    return Adapters(home() / "adapters")


def list_adapters(*, json: Flag = False) -> int:
    """List adapters, the newest last: id, robot, base, data set, what the fit saw, whether it serves.

    Parameters
    ----------
    json
        Print one JSON object on stdout.
    """
    registry = registry_of_adapters()
    damaged = {one: fault for one, fault in registry.verify().items() if fault}
    cards = [registry.card(one) for one in registry.ids() if one not in damaged]
    serving, unmeasured = registry.serving(), measured_elsewhere(registry)
    if json:
        told = {"adapters": cards, "serving": sorted(serving), "damaged": damaged}
        tell(told | {"measured_elsewhere": unmeasured})
        return Exit.SUCCESS
    if not cards and not damaged:
        Account().print(f"no adapters in {registry.folder}: {MAKE}", markup=False)
        return Exit.SUCCESS
    rows = list[tuple[str, ...]]()
    for card in cards:
        seen = "-" if card.held_out is None or card.held_out.compliance is None else f"{card.held_out.compliance:.0%}"
        base = card.base + (", bootstrapped" if card.bootstrapped else "")
        rows.append((card.id[:16], card.robot, base, card.dataset[:12], seen, "yes" if card.id in serving else "-"))
    listing(("id", "robot", "base", "data set", "held out", "serves"), rows, gives=("base",))
    for one, fault in damaged.items():
        Account().print(f"{one[:16]} is damaged{', and serves' if one in serving else ''}: {fault}")
    for one, words in unmeasured.items():
        Account().print(f"{one[:16]} {words}")
    return Exit.SUCCESS


def show(name: str, /, *, robot: str = "panda") -> int:
    """Show the card of one adapter and what became of it, as JSON. Exit code 1 if it is damaged.

    Parameters
    ----------
    name
        The beginning of its id, `champion`, the name of one that comes with dualbrain, or a folder that a fit left.
    robot
        Whose champion.
    """
    from dualbrain.adaptation.adapters.card import read_adapter_card
    from dualbrain.adaptation.adapters.naming import folder_of, id_of, in_registry
    from dualbrain.adaptation.serving.open_planner import shadow_log
    from dualbrain.adaptation.serving.shadow import glances, summary

    registry = registry_of_adapters()
    one = id_of(name, registry, robot)
    fault = registry.fault(one) if in_registry(name) else ""
    told: dict[str, Any] = (
        {"damaged": fault} if fault else {"card": read_adapter_card(folder_of(name, registry, robot))}
    )
    told["journal"] = [entry for entry in registry.journal() if entry.adapter == one]
    tell(told | {"shadow": summary(glances(shadow_log(registry.folder, one)))})
    return Exit.FAILED_SAFELY if fault else Exit.SUCCESS


def verify(*, answers: Flag = False) -> int:
    """Check that every adapter is as it was added: weights, config, card, journal. Exit code 1 if not.

    Weights are those that the id names. Of adapters added before that was kept, config and card are not recorded. Who
    serves in another runtime than it was measured in is named; nothing of it is damaged.

    Parameters
    ----------
    answers
        Also ask each one all its canaries, in the runtime that serves.
    """
    registry = registry_of_adapters()
    found, lost = registry.verify(), registry.unrecorded()
    if not found:
        Account().print(f"no adapters in {registry.folder}: {MAKE}", markup=False)
    if answers:
        found = {one: fault or canary_fault(registry, one) for one, fault in found.items()}
    for one, fault in found.items():
        unknown = (
            "" if registry.recorded(one) or one in lost else "; config and card were not recorded when it was added"
        )
        answer(f"{one[:16]} {fault or 'whole'}{unknown}")
    for one, words in measured_elsewhere(registry).items():
        answer(f"{one[:16]} {words}")
    return Exit.FAILED_SAFELY if any(found.values()) else Exit.SUCCESS


def canary_fault(registry: Adapters, one: str) -> str:
    """What is wrong with the answers of an adapter in the runtime that serves, "" if nothing is."""
    from dualbrain.adaptation.serving.open_planner import examine

    try:
        return examine(registry.at(one), cache(), registry.folder)
    except DualbrainError as error:
        return str(error)


def runtime_here(registry: Adapters, one: str) -> str:
    """The runtime in which an adapter serves here; raises `InvalidSetup`, `MissingPart` where it cannot serve."""
    from dualbrain.adaptation.serving import open_planner

    return open_planner.runtime_here(registry.at(one), cache())


def require_runtime(registry: Adapters, one: str, measured: str) -> None:
    """Raise `InvalidSetup` if `measured` is not the runtime in which an adapter serves here."""
    from dualbrain.adaptation.adapters.promotion import AGAIN

    if measured != (here := runtime_here(registry, one)):
        raise InvalidSetup("runtime of the measurement", got=measured, allowed=here, fix=AGAIN)


def measured_elsewhere(registry: Adapters) -> dict[str, str]:
    """Who serves in another runtime than it was measured in, in words by id; who cannot serve here is left out."""
    return {one: words for one in registry.serving() if (words := _elsewhere(registry, one))}


def _elsewhere(registry: Adapters, one: str) -> str:
    try:
        here = runtime_here(registry, one)
    except DualbrainError:
        return ""
    decision = registry.decision(one)
    measured = decision.runtime if decision else ""
    if measured == here:
        return ""
    how = "to measure it here, roll it back, then `dualbrain adapters measure` and `promote`"
    return f"serves in {here}, but was measured in {measured or 'a runtime that was not recorded'}: {how}"


def heard(registry: Adapters, one: str, champion: str) -> int:
    """How many whole answers an adapter gave in the shadow of who serves: of `champion`, or "" where there is none.

    Then whichever planner the robot was run with serves: its base, a model of the list, a packaged adapter, a server.
    Another adapter of the registry serves nowhere, nor does the candidate itself.
    """
    from dualbrain.adaptation.adapters.packaged import packaged_names
    from dualbrain.adaptation.adapters.stacking import author_of
    from dualbrain.adaptation.serving.open_planner import shadow_log
    from dualbrain.adaptation.serving.shadow import beside, glances, whole
    from dualbrain.planner.registry import planner_names

    known = (registry.card(one).base, *planner_names(), *packaged_names())
    serving = author_of(registry.card(champion)) if champion else ""

    def serves(author: str) -> bool:
        return author == serving if serving else author in known or "@" in author  # MODEL@HOST

    return whole(beside(glances(shadow_log(registry.folder, one)), serves))


def shadow_fault(one: str, champion: str, count: int, least: int) -> str:
    """What is lacking if an adapter gave `count` whole answers in the shadow and `least` are wanted, "" if nothing."""
    beside = "" if champion else f"@{PLANNER}"
    other = "" if champion else ", or beside another planner that the robot is run with"
    fix = f"let it hear more with `--planner shadow:{one[:16]}{beside}`{other}; or waive it: `--shadow 0`"
    return "" if count >= least else f"{count} of {least} whole answers in the shadow of who serves: {fix}"


def promote(name: str, /, *, measured: Path, shadow: Count = HEARD) -> int:
    """Let an adapter serve in place of the present champion, if it was measured better. Exit code 1 if it was not.

    Before, it must have stood in the shadow of who serves (`--planner shadow:NAME`; where no adapter is champion,
    `shadow:NAME@PLANNER` with the planner that the robot is run with), and it is asked its canaries in
    the runtime that serves: what it answers now it must answer at every start.

    Parameters
    ----------
    name
        The beginning of its id.
    measured
        A JSON file with the results of both on the same held-out questions, in the runtime that serves.
    shadow
        How many whole answers in the shadow it needs; 0 waives them, which the journal keeps.
    """
    import numpy as np

    from dualbrain.adaptation.adapters.naming import PREFIX
    from dualbrain.adaptation.adapters.promotion import Measured, Tolerances, decide
    from dualbrain.adaptation.adapters.registry import NotPromoted

    try:
        results = msgspec.json.decode(measured.read_bytes(), type=Measured)
    except UNREADABLE as error:
        allowed = "`candidate` and `champion`, each with `adapter`, `runtime`, `perplexity` and `trials`"
        raise InvalidSetup("results", got=str(error), allowed=allowed, fix=str(measured)) from error
    decision = decide(
        results.candidate, results.champion, Tolerances(), np.random.default_rng(0), dataset=results.dataset
    )
    registry = registry_of_adapters()
    registry.require_about(one := registry.find(name.removeprefix(PREFIX)), decision)
    require_runtime(registry, one, decision.runtime)
    for measure, found in decision.measures.items():
        surely = "" if found.low is None else f", 95 %: {found.low:+.4g} to {found.high:+.4g}"
        Account().print(f"{measure}: {found.before:.4g} -> {found.after:.4g}, gain {found.gain:+.4g}{surely}")
    count = heard(registry, one, decision.champion)
    if decision.promotes and (
        fault := shadow_fault(one, decision.champion, count, shadow) or canary_fault(registry, one)
    ):
        Account().print(f"not promoted: {fault}")
        return Exit.FAILED_SAFELY
    reason = f"{count} answers in the shadow" if shadow else f"the shadow was waived, with {count} answers in it"
    try:
        registry.promote(one, decision, now=time.time(), reason=reason)
    except NotPromoted as why:
        Account().print(str(why))
        return Exit.FAILED_SAFELY
    card = registry.card(one)
    Account().print(
        f"promoted: adapter {one[:16]} on {card.base} is the champion of {card.robot} now. It answers where "
        f"`--planner adapter:champion` is said; without --planner {PLANNER} still does."
    )
    return Exit.SUCCESS


def rollback(*, reason: str, robot: str = "panda", base: str = "") -> int:
    """Let the former champion serve again, at last the bare base. Exit code 1 if it does not answer as it did.

    It is asked its canaries afterwards: whoever has to go back is not kept from it, but told what serves now.

    Parameters
    ----------
    reason
        Why, in a few words.
    robot
        Whose planner.
    base
        On which base: from `dualbrain models list`, or base-135m; without it that of adapter:champion.
    """
    from dualbrain.adaptation.adapters.base_models import hash_of_base
    from dualbrain.adaptation.adapters.naming import place_of_champion

    registry = registry_of_adapters()
    place = (robot, hash_of_base(base)) if base else place_of_champion(registry, robot)
    now = registry.roll_back(place, reason, now=time.time())
    Account().print(f"{now[:16] or 'the bare base'} serves again")
    if now and (fault := canary_fault(registry, now)):
        Account().print(f"but it will propose nothing: {fault}. Roll back once more, or mend that.")
        return Exit.FAILED_SAFELY
    if now:
        Account().print("its canaries are answered as they were")
    return Exit.SUCCESS


def history(*, json: Flag = False) -> int:
    """List what was done to adapters, the oldest first.

    Parameters
    ----------
    json
        Print one JSON object on stdout.
    """
    entries: Any = registry_of_adapters().journal()
    if json:
        tell({"journal": entries})
        return Exit.SUCCESS
    for entry in entries:
        when = datetime.fromtimestamp(entry.time, UTC).strftime("%Y-%m-%d %H:%M")
        answer(f"{when} {entry.kind} {entry.adapter[:16] or 'the bare base'} {entry.reason}".rstrip())
    return Exit.SUCCESS
