"""dualbrain adapters: what was fitted, which one serves, and changing that by measurement only."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter, validators

from dualbrain.cli.common.console import StderrConsole, print_result, print_table
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.paths import cache_folder, dualbrain_home
from dualbrain.cli.memory.open_memory import print_json
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, DualbrainError
from dualbrain.planner.registry import DEFAULT_PLANNER

if TYPE_CHECKING:
    from dualbrain.adaptation.adapters.registry import AdapterRegistry

Flag = Annotated[bool, Parameter(negative="")]
Count = Annotated[int, Parameter(validator=validators.Number(gte=0))]
MAKE_HINT = "`dualbrain adapt` makes them, of what went well"
MIN_SHADOW_ANSWERS = 10
"""Whole answers in the shadow before a promotion: enough to see that it answers what is really asked; no measure."""


def open_adapter_registry() -> AdapterRegistry:
    """The registry in dualbrain's home."""
    from dualbrain.adaptation.adapters.registry import AdapterRegistry

    return AdapterRegistry(dualbrain_home() / "adapters")


def list_adapters(*, json: Flag = False) -> int:
    """List adapters, the newest last: id, robot, base, data set, what the fit saw, whether it serves.

    Parameters
    ----------
    json
        Print one JSON object on stdout.
    """
    registry = open_adapter_registry()
    damaged = {one: fault for one, fault in registry.verify().items() if fault}
    cards = [registry.card(one) for one in registry.ids() if one not in damaged]
    serving, unmeasured = registry.serving_ids(), runtime_mismatches(registry)
    if json:
        told = {"adapters": cards, "serving": sorted(serving), "damaged": damaged}
        print_json(told | {"measured_elsewhere": unmeasured})
        return ExitCode.SUCCESS
    if not cards and not damaged:
        StderrConsole().print(f"no adapters in {registry.folder}: {MAKE_HINT}", markup=False)
        return ExitCode.SUCCESS
    rows = list[tuple[str, ...]]()
    for card in cards:
        seen = "-" if card.held_out is None or card.held_out.compliance is None else f"{card.held_out.compliance:.0%}"
        base = card.base + (", bootstrapped" if card.bootstrapped else "")
        rows.append((card.id[:16], card.robot, base, card.dataset[:12], seen, "yes" if card.id in serving else "-"))
    print_table(("id", "robot", "base", "data set", "held out", "serves"), rows, wrap_columns=("base",))
    for one, fault in damaged.items():
        StderrConsole().print(f"{one[:16]} is damaged{', and serves' if one in serving else ''}: {fault}")
    for one, words in unmeasured.items():
        StderrConsole().print(f"{one[:16]} {words}")
    return ExitCode.SUCCESS


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
    from dualbrain.adaptation.adapters.naming import is_registry_name, resolve_folder, resolve_id
    from dualbrain.adaptation.serving.open_planner import shadow_log_path
    from dualbrain.adaptation.serving.shadow import read_shadow_log, summarize_shadow

    registry = open_adapter_registry()
    one = resolve_id(name, registry, robot)
    fault = registry.find_fault(one) if is_registry_name(name) else ""
    told: dict[str, Any] = (
        {"damaged": fault} if fault else {"card": read_adapter_card(resolve_folder(name, registry, robot))}
    )
    told["journal"] = [entry for entry in registry.entries() if entry.adapter == one]
    print_json(told | {"shadow": summarize_shadow(read_shadow_log(shadow_log_path(registry.folder, one)))})
    return ExitCode.FAILED_SAFELY if fault else ExitCode.SUCCESS


def verify(*, answers: Flag = False) -> int:
    """Check that every adapter is as it was added: weights, config, card, journal. Exit code 1 if not.

    Weights are those that the id names. Of adapters added before that was kept, config and card are not recorded. Who
    serves in another runtime than it was measured in is named; nothing of it is damaged.

    Parameters
    ----------
    answers
        Also ask each one all its canaries, in the runtime that serves.
    """
    registry = open_adapter_registry()
    found, lost = registry.verify(), registry.unrecorded_ids()
    if not found:
        StderrConsole().print(f"no adapters in {registry.folder}: {MAKE_HINT}", markup=False)
    if answers:
        found = {one: fault or canary_error(registry, one) for one, fault in found.items()}
    for one, fault in found.items():
        unknown = (
            ""
            if registry.recorded_hashes(one) or one in lost
            else "; config and card were not recorded when it was added"
        )
        print_result(f"{one[:16]} {fault or 'whole'}{unknown}")
    for one, words in runtime_mismatches(registry).items():
        print_result(f"{one[:16]} {words}")
    return ExitCode.FAILED_SAFELY if any(found.values()) else ExitCode.SUCCESS


def canary_error(registry: AdapterRegistry, one: str) -> str:
    """What is wrong with the answers of an adapter in the runtime that serves, "" if nothing is."""
    from dualbrain.adaptation.serving.open_planner import check_canaries

    try:
        return check_canaries(registry.adapter_folder(one), cache_folder(), registry.folder)
    except DualbrainError as error:
        return str(error)


def serving_runtime(registry: AdapterRegistry, one: str) -> str:
    """The runtime in which an adapter serves here; raises `InvalidSetup`, `MissingPart` where it cannot serve."""
    from dualbrain.adaptation.serving import open_planner

    return open_planner.local_runtime(registry.adapter_folder(one), cache_folder())


def require_runtime(registry: AdapterRegistry, one: str, measured: str) -> None:
    """Raise `InvalidSetup` if `measured` is not the runtime in which an adapter serves here."""
    from dualbrain.adaptation.adapters.promotion import MEASURE_AGAIN_HINT

    if measured != (here := serving_runtime(registry, one)):
        raise ConfigurationError("runtime of the measurement", got=measured, allowed=here, fix=MEASURE_AGAIN_HINT)


def runtime_mismatches(registry: AdapterRegistry) -> dict[str, str]:
    """Who serves in another runtime than it was measured in, in words by id; who cannot serve here is left out."""
    return {one: words for one in registry.serving_ids() if (words := _runtime_mismatch(registry, one))}


def _runtime_mismatch(registry: AdapterRegistry, one: str) -> str:
    try:
        here = serving_runtime(registry, one)
    except DualbrainError:
        return ""
    decision = registry.last_decision(one)
    measured = decision.runtime if decision else ""
    if measured == here:
        return ""
    how = "to measure it here, roll it back, then `dualbrain adapters measure` and `promote`"
    return f"serves in {here}, but was measured in {measured or 'a runtime that was not recorded'}: {how}"


def count_shadow_answers(registry: AdapterRegistry, one: str, champion: str) -> int:
    """How many whole answers an adapter gave in the shadow of who serves: of `champion`, or "" where there is none.

    Then whichever planner the robot was run with serves: its base, a model of the list, a packaged adapter, a server.
    Another adapter of the registry serves nowhere, nor does the candidate itself.
    """
    from dualbrain.adaptation.adapters.packaged import packaged_names
    from dualbrain.adaptation.adapters.stacking import adapter_author
    from dualbrain.adaptation.serving.open_planner import shadow_log_path
    from dualbrain.adaptation.serving.shadow import count_complete, filter_by_serving, read_shadow_log
    from dualbrain.planner.registry import planner_names

    known = (registry.card(one).base, *planner_names(), *packaged_names())
    serving = adapter_author(registry.card(champion)) if champion else ""

    def serves(author: str) -> bool:
        return author == serving if serving else author in known or "@" in author  # MODEL@HOST

    return count_complete(filter_by_serving(read_shadow_log(shadow_log_path(registry.folder, one)), serves))


def shadow_shortfall(one: str, champion: str, count: int, min_count: int) -> str:
    """What is lacking if an adapter gave `count` whole answers in the shadow and `least` are wanted, "" if nothing."""
    beside = "" if champion else f"@{DEFAULT_PLANNER}"
    other = "" if champion else ", or beside another planner that the robot is run with"
    fix = f"let it hear more with `--planner shadow:{one[:16]}{beside}`{other}; or waive it: `--shadow 0`"
    return "" if count >= min_count else f"{count} of {min_count} whole answers in the shadow of who serves: {fix}"


def promote(name: str, /, *, measured: Path, shadow: Count = MIN_SHADOW_ANSWERS) -> int:
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

    from dualbrain.adaptation.adapters.naming import ADAPTER_PREFIX
    from dualbrain.adaptation.adapters.promotion import Measurement, Tolerances, decide_promotion
    from dualbrain.adaptation.adapters.registry import NotPromotedError

    try:
        results = msgspec.json.decode(measured.read_bytes(), type=Measurement)
    except DECODE_ERRORS as error:
        allowed = "`candidate` and `champion`, each with `adapter`, `runtime`, `perplexity` and `trials`"
        raise ConfigurationError("results", got=str(error), allowed=allowed, fix=str(measured)) from error
    decision = decide_promotion(
        results.candidate, results.champion, Tolerances(), np.random.default_rng(0), dataset=results.dataset
    )
    registry = open_adapter_registry()
    registry.require_decision_about(one := registry.find(name.removeprefix(ADAPTER_PREFIX)), decision)
    require_runtime(registry, one, decision.runtime)
    for measure, found in decision.measures.items():
        surely = "" if found.low is None else f", 95 %: {found.low:+.4g} to {found.high:+.4g}"
        StderrConsole().print(f"{measure}: {found.before:.4g} -> {found.after:.4g}, gain {found.gain:+.4g}{surely}")
    count = count_shadow_answers(registry, one, decision.champion)
    if decision.promotes and (
        fault := shadow_shortfall(one, decision.champion, count, shadow) or canary_error(registry, one)
    ):
        StderrConsole().print(f"not promoted: {fault}")
        return ExitCode.FAILED_SAFELY
    reason = f"{count} answers in the shadow" if shadow else f"the shadow was waived, with {count} answers in it"
    try:
        registry.promote(one, decision, now=time.time(), reason=reason)
    except NotPromotedError as why:
        StderrConsole().print(str(why))
        return ExitCode.FAILED_SAFELY
    card = registry.card(one)
    StderrConsole().print(
        f"promoted: adapter {one[:16]} on {card.base} is the champion of {card.robot} now. It answers where "
        f"`--planner adapter:champion` is said; without --planner {DEFAULT_PLANNER} still does."
    )
    return ExitCode.SUCCESS


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
    from dualbrain.adaptation.adapters.base_models import base_model_hash
    from dualbrain.adaptation.adapters.naming import champion_place

    registry = open_adapter_registry()
    place = (robot, base_model_hash(base)) if base else champion_place(registry, robot)
    now = registry.roll_back(place, reason, now=time.time())
    StderrConsole().print(f"{now[:16] or 'the bare base'} serves again")
    if now and (fault := canary_error(registry, now)):
        StderrConsole().print(f"but it will propose nothing: {fault}. Roll back once more, or mend that.")
        return ExitCode.FAILED_SAFELY
    if now:
        StderrConsole().print("its canaries are answered as they were")
    return ExitCode.SUCCESS


def history(*, json: Flag = False) -> int:
    """List what was done to adapters, the oldest first.

    Parameters
    ----------
    json
        Print one JSON object on stdout.
    """
    entries: Any = open_adapter_registry().entries()
    if json:
        print_json({"journal": entries})
        return ExitCode.SUCCESS
    for entry in entries:
        when = datetime.fromtimestamp(entry.time, UTC).strftime("%Y-%m-%d %H:%M")
        print_result(f"{when} {entry.kind} {entry.adapter[:16] or 'the bare base'} {entry.reason}".rstrip())
    return ExitCode.SUCCESS
