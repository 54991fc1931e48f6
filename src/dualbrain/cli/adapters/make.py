"""dualbrain adapters make: the adapters that dualbrain ships, made again from nothing but the base model."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from dualbrain.cli.adapters.process_launcher import account_of, team_here
from dualbrain.cli.common.console import Account
from dualbrain.cli.common.exit_codes import Exit
from dualbrain.cli.common.paths import cache
from dualbrain.cli.memory.open_memory import tell
from dualbrain.errors import InvalidSetup, UnknownName

if TYPE_CHECKING:
    from dualbrain.adaptation.training.process_group import Team
    from dualbrain.contracts.registry import Registry

DATASET = "dataset"
Flag = Annotated[bool, Parameter(negative="")]


def make(name: str, /, *, out: Path | None = None, json: Flag = False) -> int:
    """Make a shipped adapter again: draw its lessons, fit it, write it with its card.

    base-135m is SmolLM2 taught the language of contracts of panda, ur5e and base: templates with random valid
    parameters, nothing carried out. It plans, and knows nothing of any body. starter-135m is that one after a
    first night: such contracts for the panda, each carried out in its scene, and those taught that went well.
    Interrupted in any way, the same command with the same --out goes on where it was. A data set there that is not the
    one which that adapter is taught today is refused.

    Parameters
    ----------
    name
        Which one: base-135m, starter-135m.
    out
        Where lessons, ledger, checkpoints and adapter go; default a new folder under runs.
    json
        Print the card as one JSON object on stdout.
    """
    if name not in _MAKERS:
        raise UnknownName("shipped adapter", name, tuple(_MAKERS))
    from dualbrain.cli.adapters.adapt import adapt_with_torch, kept_in

    folder = out or Path("runs") / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-{name}"
    with team_here(adapt_with_torch, out) as team, kept_in(folder, account_of(team)):
        card = _MAKERS[name](folder, team)
        if json and team.rank == 0:
            tell(card)
    return Exit.SUCCESS


# --- base-135m --------------------------------------------------------------------------------------------------------


def _base_135m(folder: Path, team: Team) -> Any:
    from dualbrain.adaptation.synthetic.dataset import DIALS
    from dualbrain.grounding.vocabulary import vocabulary
    from dualbrain.runtime.data_collection.synthetic_scenes import ROBOTS

    registries = {robot: vocabulary(robot) for robot in ROBOTS}
    team.once(lambda: _draw(folder, registries))
    return _fit("smollm2-135m-instruct", DIALS, registries, folder, team)


def _draw(folder: Path, registries: Mapping[str, Registry]) -> None:
    """Write the lessons into `folder`, unless they are there already."""
    from dualbrain.adaptation.curation.dataset import read_card, write_dataset
    from dualbrain.adaptation.synthetic.dataset import CHECKS, LESSONS, course, not_course
    from dualbrain.runtime.data_collection.synthetic_scenes import lessons

    if (folder / DATASET / "dataset.json").is_file():
        _require_own("base-135m", folder, not_course(read_card(folder / DATASET), registries))
        Account().print(f"going on with the lessons in {folder}")
    else:
        write_dataset(course(lessons(LESSONS, "teach"), lessons(CHECKS, "check"), registries), folder / DATASET)


# --- starter-135m -----------------------------------------------------------------------------------------------------


def _starter_135m(folder: Path, team: Team) -> Any:
    from dualbrain.grounding.vocabulary import vocabulary
    from dualbrain.runtime.data_collection import starter_dataset as starter
    from dualbrain.runtime.data_collection.rollouts import ROBOT

    team.once(lambda: _live(folder))
    return _fit(starter.BASE, starter.DIALS, {ROBOT: vocabulary(ROBOT)}, folder, team)


def _live(folder: Path) -> None:
    """Carry out what is proposed, and write what went well into `folder`, unless that is there already."""
    from dualbrain.adaptation.curation.dataset import read_card, read_dataset, write_dataset
    from dualbrain.runtime.data_collection import starter_dataset as starter

    account, day = Account(), folder / "day"
    if (folder / DATASET / "dataset.json").is_file():
        others = starter.not_taught(read_card(folder / DATASET), day, starter.PROPOSALS)
        _require_own("starter-135m", folder, others)
        account.print(f"going on with the data set in {folder}")
    else:
        told = _flights_told(account, starter.PROPOSALS)
        lived = starter.first_day(day, starter.PROPOSALS, cache=cache(), tell=told)
        write_dataset(starter.taught(lived), folder / DATASET)
    data = read_dataset(folder / DATASET)
    reasons = "".join(f"; {number} {reason}" for reason, number in data.card.left_out.items())
    account.print(f"{data.card.train} samples to train on, {data.card.held_out} held out{reasons}")


def _flights_told(account: Account, number: int) -> Callable[[int, Any], None]:
    """Prints each flight with the time left, at the pace of those since the start of this command."""
    began, flown = time.monotonic(), count(1)

    def told(done: int, episode: Any) -> None:
        outcome, left = episode.outcome, (time.monotonic() - began) / next(flown) * (number - done)
        size = "" if outcome.Delta is None else f"  Δ {outcome.Delta:.4f}"
        account.print(f"flight {done}/{number}  {outcome.kind}{size}  {left / 60.0:.1f} min left")

    return told


# --- both -------------------------------------------------------------------------------------------------------------


def _require_own(name: str, folder: Path, others: str) -> None:
    """Raise `InvalidSetup` if the data set in `folder` differs, in `others`, from the one that `name` is taught."""
    if others:
        fix = "It is another one's, or what it was made for has changed since. Name another --out to make it anew."
        raise InvalidSetup(f"data set in {folder}", got=others, allowed=f"what {name} is taught today", fix=fix)


def _fit(base: str, dials: Any, registries: Mapping[str, Registry], folder: Path, team: Team) -> Any:
    """The card of an adapter of `base`, fitted on the data set in `folder`."""
    from dualbrain.adaptation.adapters.base_models import find_base
    from dualbrain.adaptation.curation.dataset import read_dataset
    from dualbrain.adaptation.synthetic.dataset import language_judge
    from dualbrain.cli.adapters.adapt import adapt_with_torch, step_words

    account = account_of(team)
    card = adapt_with_torch().adapt(
        read_dataset(folder / DATASET), dials, find_base(base, cache()), language_judge(registries), folder,
        cache=cache(), clock=time.monotonic, tell=lambda progress: account.print(step_words(progress)), team=team,
    )  # fmt: skip
    account.print(f"adapter {card.id} in {folder / 'adapter'}")
    return card


_MAKERS: dict[str, Callable[[Path, Team], Any]] = {"base-135m": _base_135m, "starter-135m": _starter_135m}
