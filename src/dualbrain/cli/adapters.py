"""dualbrain adapters: what was fitted, which one serves, and changing that by measurement only."""

from __future__ import annotations

import shutil
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from dualbrain.cli.console import Account, answer
from dualbrain.cli.exits import Exit
from dualbrain.cli.folders import home
from dualbrain.cli.memory_open import tell
from dualbrain.errors import InvalidSetup

if TYPE_CHECKING:
    from dualbrain.adaptation.adapters import Adapters

Flag = Annotated[bool, Parameter(negative="")]


def registry_of_adapters() -> Adapters:
    """The registry in dualbrain's home."""
    from dualbrain.adaptation.adapters import Adapters

    return Adapters(home() / "adapters")


def list_adapters(*, json: Flag = False) -> int:
    """List adapters, the newest last: id, robot, base, data set, what the fit saw, whether it serves.

    Parameters
    ----------
    json
        Print one JSON object on stdout.
    """
    from dualbrain.adaptation.adapters import place_of

    registry = registry_of_adapters()
    cards = [registry.card(one) for one in registry.ids()]
    serving = {card.id for card in cards if registry.champion(place_of(card)) == card.id}
    if json:
        tell({"adapters": cards, "serving": sorted(serving)})
        return Exit.SUCCESS
    table = Table("id", "robot", "base", "data set", "held out", "serves", box=None, pad_edge=False)
    for card in cards:
        seen = "-" if card.held_out is None or card.held_out.compliance is None else f"{card.held_out.compliance:.0%}"
        base = card.base + (", bootstrapped" if card.bootstrapped else "")
        table.add_row(card.id[:16], card.robot, base, card.dataset[:12], seen, "yes" if card.id in serving else "-")
    Console().print(table)
    return Exit.SUCCESS


def show(name: str, /) -> int:
    """Show the card of one adapter and what became of it, as JSON.

    Parameters
    ----------
    name
        The beginning of its id.
    """
    registry = registry_of_adapters()
    card = registry.card(name)
    tell({"card": card, "journal": [entry for entry in registry.journal() if entry.adapter == card.id]})
    return Exit.SUCCESS


def verify() -> int:
    """Check that the weights of every adapter are those that its id names. Exit code 1 if not."""
    found = registry_of_adapters().verify()
    for one, fault in found.items():
        answer(f"{one[:16]} {fault or 'whole'}")
    return Exit.FAILED_SAFELY if any(found.values()) else Exit.SUCCESS


def promote(name: str, /, *, measured: Path) -> int:
    """Let an adapter serve in place of the present champion, if it was measured better. Exit code 1 if it was not.

    Parameters
    ----------
    name
        The beginning of its id.
    measured
        A JSON file with the results of both on the same held-out questions, in the runtime that serves.
    """
    import numpy as np

    from dualbrain.adaptation.adapters import NotPromoted
    from dualbrain.adaptation.promotion import Measured, Tolerances, decide

    try:
        results = msgspec.json.decode(measured.read_bytes(), type=Measured)
    except msgspec.DecodeError as error:
        allowed = "`candidate` and `champion`, each with `adapter`, `runtime`, `perplexity` and `trials`"
        raise InvalidSetup("results", got=str(error), allowed=allowed, fix=str(measured)) from error
    decision = decide(results.candidate, results.champion, Tolerances(), np.random.default_rng(0))
    for measure, found in decision.measures.items():
        surely = "" if found.low is None else f", 95 %: {found.low:+.4g} to {found.high:+.4g}"
        Account().print(f"{measure}: {found.before:.4g} -> {found.after:.4g}, gain {found.gain:+.4g}{surely}")
    try:
        registry_of_adapters().promote(name, decision, now=time.time())
    except NotPromoted as why:
        Account().print(str(why))
        return Exit.FAILED_SAFELY
    Account().print("promoted")
    return Exit.SUCCESS


def rollback(*, reason: str, robot: str = "panda", base: str = "smollm2-135m-instruct") -> int:
    """Let the former champion serve again, at last the bare base.

    Parameters
    ----------
    reason
        Why, in a few words.
    robot
        Whose planner.
    base
        On which base.
    """
    from dualbrain.weights import find_file

    now = registry_of_adapters().roll_back((robot, find_file(base).sha256), reason, now=time.time())
    Account().print(f"{now[:16] or 'the bare base'} serves again")
    return Exit.SUCCESS


def export(name: str, out: Path, /) -> int:
    """Copy an adapter, verified, to a new folder that peft and vLLM load.

    Parameters
    ----------
    name
        The beginning of its id.
    out
        The folder.
    """
    registry = registry_of_adapters()
    card = registry.card(name)
    shutil.copytree(registry.folder / card.id, out)
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
