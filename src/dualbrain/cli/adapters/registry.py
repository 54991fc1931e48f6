"""`dualbrain adapters`: list, show and verify adapters, and change the serving one by measurement only."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter, validators

from dualbrain.cli.common.console import StderrConsole, print_result, print_table
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.memory.open_memory import print_json
from dualbrain.core.paths import cache_folder, dualbrain_home
from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, DualbrainError
from dualbrain.planner.registry import DEFAULT_PLANNER

MAX_MEASUREMENT_BYTES = 64 << 20

if TYPE_CHECKING:
    from dualbrain.adaptation.adapters.promotion import PromotionDecision
    from dualbrain.adaptation.adapters.registry import AdapterRegistry

Flag = Annotated[bool, Parameter(negative="")]
Count = Annotated[int, Parameter(validator=validators.Number(gte=0))]
MAKE_HINT = "`dualbrain adapt` makes them from successful episodes"
MIN_SHADOW_ANSWERS = 10
"""Complete shadow answers required for a promotion: enough to see that the adapter answers real questions."""


def open_adapter_registry() -> AdapterRegistry:
    """The registry in dualbrain's home."""
    from dualbrain.adaptation.adapters.registry import AdapterRegistry

    return AdapterRegistry(dualbrain_home() / "adapters")


def list_adapters(*, json: Flag = False) -> int:
    """List adapters, the newest last: id, robot, base, data set, held-out result, whether it serves.

    Parameters
    ----------
    json
        Print one JSON object on stdout.
    """
    registry = open_adapter_registry()
    damaged = {one: fault for one, fault in registry.verify().items() if fault}
    cards = [registry.card(one) for one in registry.ids() if one not in damaged]
    serving, mismatches = registry.serving_ids(), runtime_mismatches(registry)
    if json:
        fields = {"adapters": cards, "serving": sorted(serving), "damaged": damaged}
        print_json(fields | {"measured_elsewhere": mismatches})
        return ExitCode.SUCCESS
    if not cards and not damaged:
        StderrConsole().print(f"no adapters in {registry.folder}: {MAKE_HINT}", markup=False)
        return ExitCode.SUCCESS
    rows = list[tuple[str, ...]]()
    for card in cards:
        compliance = (
            "-" if card.held_out is None or card.held_out.compliance is None else f"{card.held_out.compliance:.0%}"
        )
        base = card.base + (", bootstrapped" if card.bootstrapped else "")
        rows.append(
            (card.id[:16], card.robot, base, card.dataset[:12], compliance, "yes" if card.id in serving else "-")
        )
    print_table(("id", "robot", "base", "data set", "held out", "serves"), rows, wrap_columns=("base",))
    for one, fault in damaged.items():
        StderrConsole().print(f"{one[:16]} is damaged{', and serves' if one in serving else ''}: {fault}", markup=False)
    for one, mismatch in mismatches.items():
        StderrConsole().print(f"{one[:16]} {mismatch}", markup=False)
    return ExitCode.SUCCESS


def show(name: str, /, *, robot: str = "panda") -> int:
    """Show the card, history and shadow results of one adapter as JSON. Exit code 1 if it is damaged.

    Parameters
    ----------
    name
        The beginning of an id, `champion`, the name of a packaged adapter, or a folder that training wrote.
    robot
        The robot of `champion`.
    """
    from dualbrain.adaptation.adapters.card import read_adapter_card
    from dualbrain.adaptation.adapters.naming import is_registry_name, resolve_folder, resolve_id
    from dualbrain.adaptation.serving.open_planner import shadow_log_path
    from dualbrain.adaptation.serving.shadow import read_shadow_log, summarize_shadow

    registry = open_adapter_registry()
    one = resolve_id(name, registry, robot)
    fault = registry.find_fault(one) if is_registry_name(name) else ""
    fields: dict[str, Any] = (
        {"damaged": fault} if fault else {"card": read_adapter_card(resolve_folder(name, registry, robot))}
    )
    fields["journal"] = [entry for entry in registry.entries() if entry.adapter == one]
    print_json(fields | {"shadow": summarize_shadow(read_shadow_log(shadow_log_path(registry.folder, one)))})
    return ExitCode.FAILED_SAFELY if fault else ExitCode.SUCCESS


def verify(*, answers: Flag = False) -> int:
    """Check that every adapter is as it was added: weights, config, card, log. Exit code 1 if not.

    Weights are checked against the id. Config and card of adapters from older versions have no recorded hash. An
    adapter that serves in another runtime than it was measured in is reported, but is not damaged.

    Parameters
    ----------
    answers
        Also ask each adapter all its canaries, in the serving runtime.
    """
    registry = open_adapter_registry()
    found, unrecorded = registry.verify(), registry.unrecorded_ids()
    if not found:
        StderrConsole().print(f"no adapters in {registry.folder}: {MAKE_HINT}", markup=False)
    if answers:
        found = {one: fault or canary_error(registry, one) for one, fault in found.items()}
    for one, fault in found.items():
        remark = (
            ""
            if registry.recorded_hashes(one) or one in unrecorded
            else "; config and card were not recorded when it was added"
        )
        print_result(f"{one[:16]} {fault or 'intact'}{remark}")
    for one, mismatch in runtime_mismatches(registry).items():
        print_result(f"{one[:16]} {mismatch}")
    return ExitCode.FAILED_SAFELY if any(found.values()) else ExitCode.SUCCESS


def canary_error(registry: AdapterRegistry, adapter_id: str) -> str:
    """The fault in the answers of an adapter in the serving runtime, "" if there is none."""
    from dualbrain.adaptation.serving.open_planner import check_canaries

    try:
        return check_canaries(registry.adapter_folder(adapter_id), cache_folder(), registry.folder)
    except DualbrainError as error:
        return str(error)


def serving_runtime(registry: AdapterRegistry, adapter_id: str) -> str:
    """The runtime in which an adapter serves here.

    Raises `ConfigurationError` or `MissingDependencyError` if it cannot serve.
    """
    from dualbrain.adaptation.serving import open_planner

    return open_planner.local_runtime(registry.adapter_folder(adapter_id), cache_folder())


def require_runtime(registry: AdapterRegistry, adapter_id: str, measured: str) -> None:
    """Raise `ConfigurationError` if `measured` is not the runtime in which an adapter serves here."""
    from dualbrain.adaptation.adapters.promotion import MEASURE_AGAIN_HINT

    if measured != (here := serving_runtime(registry, adapter_id)):
        problem = f"The adapter was measured in the runtime {measured}, but it is served in {here}."
        raise ConfigurationError.stating(problem, fix=MEASURE_AGAIN_HINT)


def runtime_mismatches(registry: AdapterRegistry) -> dict[str, str]:
    """Adapters that serve in another runtime than they were measured in, in words by id.

    An adapter that cannot serve here is left out.
    """
    return {one: mismatch for one in registry.serving_ids() if (mismatch := _runtime_mismatch(registry, one))}


def _runtime_mismatch(registry: AdapterRegistry, one: str) -> str:
    try:
        here = serving_runtime(registry, one)
    except DualbrainError:
        return ""
    decision = registry.last_decision(one)
    measured = decision.runtime if decision else ""
    if measured == here:
        return ""
    fix = "to measure it here, roll it back, then use `dualbrain adapters measure` and `promote`"
    return f"serves in {here}, but was measured in {measured or 'a runtime that was not recorded'}: {fix}"


def read_decision(measured: Path) -> PromotionDecision:
    """The decision of the promotion gate about the measurement in the file `measured`; raises `ConfigurationError`."""
    import numpy as np

    from dualbrain.adaptation.adapters.promotion import Measurement, Tolerances, decide_promotion

    try:
        results = msgspec.json.decode(read_bounded_file(measured, MAX_MEASUREMENT_BYTES), type=Measurement)
    except DECODE_ERRORS as error:
        fix = f"Write them with `dualbrain adapters measure`. {measured}"
        raise ConfigurationError.stating(f"The results of the measurement cannot be read: {error}.", fix=fix) from error
    return decide_promotion(
        results.candidate, results.champion, Tolerances(), np.random.default_rng(0), dataset=results.dataset
    )


def count_shadow_answers(registry: AdapterRegistry, adapter_id: str, champion: str) -> int:
    """Number of complete answers of an adapter in the shadow of `champion`, or of any serving planner if that is "".

    Without a champion, any planner that the robot was run with may serve: a base, a model of the list, a packaged
    adapter, a server. Answers in the shadow of the candidate itself or of another registered adapter do not count.
    """
    from dualbrain.adaptation.adapters.packaged import packaged_names
    from dualbrain.adaptation.adapters.stacking import adapter_author
    from dualbrain.adaptation.serving.open_planner import shadow_log_path
    from dualbrain.adaptation.serving.shadow import count_complete, filter_by_serving, read_shadow_log
    from dualbrain.planner.registry import planner_names

    known = (registry.card(adapter_id).base, *planner_names(), *packaged_names())
    serving = adapter_author(registry.card(champion)) if champion else ""

    def serves(author: str) -> bool:
        return author == serving if serving else author in known or "@" in author  # MODEL@HOST

    return count_complete(filter_by_serving(read_shadow_log(shadow_log_path(registry.folder, adapter_id)), serves))


def shadow_shortfall(adapter_id: str, champion: str, count: int, min_count: int) -> str:
    """Why `count` complete shadow answers are fewer than required, with the remedy; "" if they suffice."""
    serving = "" if champion else f"@{DEFAULT_PLANNER}"
    other = "" if champion else ", or with another serving planner"
    fix = f"collect more with `--planner shadow:{adapter_id[:16]}{serving}`{other}; or waive them with `--shadow 0`"
    problem = f"{count} of {min_count} complete shadow answers beside the serving planner"
    return "" if count >= min_count else f"{problem}: {fix}"


def promote(name: str, /, *, measured: Path, shadow: Count = MIN_SHADOW_ANSWERS) -> int:
    """Make an adapter the champion, if it was measured better than the present one. Exit code 1 if it was not.

    Before, it must have run in the shadow of the serving planner (`--planner shadow:NAME`; if no adapter is champion,
    `shadow:NAME@PLANNER` with the planner of the robot). Its canaries are asked in the serving runtime; it must give
    the same answers at every start.

    Parameters
    ----------
    name
        The beginning of an id.
    measured
        A JSON file with the results of both planners on the same held-out questions, in the serving runtime.
    shadow
        Number of complete shadow answers that it needs; 0 waives them, which the log records.
    """
    from dualbrain.adaptation.adapters.naming import ADAPTER_PREFIX
    from dualbrain.adaptation.adapters.registry import NotPromotedError

    decision = read_decision(measured)
    registry = open_adapter_registry()
    registry.require_decision_about(one := registry.find(name.removeprefix(ADAPTER_PREFIX)), decision)
    require_runtime(registry, one, decision.runtime)
    for measure, found in decision.measures.items():
        interval = "" if found.low is None else f", 95 %: {found.low:+.4g} to {found.high:+.4g}"
        interval += "" if found.p is None else f", corrected p {found.p:.2g}"
        StderrConsole().print(
            f"{measure}: {found.before:.4g} -> {found.after:.4g}, gain {found.gain:+.4g}{interval}", markup=False
        )
    count = count_shadow_answers(registry, one, decision.champion)
    if decision.promotes and (
        fault := shadow_shortfall(one, decision.champion, count, shadow) or canary_error(registry, one)
    ):
        StderrConsole().print(f"not promoted: {fault}", markup=False)
        return ExitCode.FAILED_SAFELY
    reason = f"{count} answers in the shadow" if shadow else f"the shadow was waived, with {count} answers in it"
    try:
        registry.promote(one, decision, now=time.time(), reason=reason)
    except NotPromotedError as why:
        StderrConsole().print(str(why), markup=False)
        return ExitCode.FAILED_SAFELY
    card = registry.card(one)
    StderrConsole().print(
        f"promoted: adapter {one[:16]} on {card.base} is the champion of {card.robot} now. Select it with "
        f"`--planner adapter:champion`; the default of --planner is still {DEFAULT_PLANNER}.",
        markup=False,
    )
    return ExitCode.SUCCESS


def rollback(*, reason: str, robot: str = "panda", base: str = "") -> int:
    """Make the former champion serve again, or the bare base. Exit code 1 if its answers are not the recorded ones.

    Its canaries are asked afterwards: the rollback is done in any case, and the result is reported.

    Parameters
    ----------
    reason
        The reason, in a few words.
    robot
        The robot of the champion.
    base
        The base: from `dualbrain models list`, or base-135m; default that of adapter:champion.
    """
    from dualbrain.adaptation.adapters.base_models import base_model_hash
    from dualbrain.adaptation.adapters.naming import champion_place

    registry = open_adapter_registry()
    place = (robot, base_model_hash(base)) if base else champion_place(registry, robot)
    now = registry.roll_back(place, reason, now=time.time())
    StderrConsole().print(f"{now[:16] or 'the bare base'} serves again")
    if now and (fault := canary_error(registry, now)):
        StderrConsole().print(
            f"but it will make no proposals: {fault}. Roll back again, or remove the fault.", markup=False
        )
        return ExitCode.FAILED_SAFELY
    if now:
        StderrConsole().print("its canary answers are the recorded ones")
    return ExitCode.SUCCESS


def history(*, json: Flag = False) -> int:
    """List all changes of adapters, the oldest first.

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
