"""dualbrain adapt: what the ledger would teach, and fitting an adapter on it."""

from __future__ import annotations

import shlex
import time
from collections.abc import Generator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from dualbrain.cli.adapters.process_launcher import console_of, is_distributed, process_group
from dualbrain.cli.common.console import StderrConsole, format_table
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.paths import cache_folder
from dualbrain.cli.memory.open_memory import open_reader, print_json
from dualbrain.errors import ConfigurationError, DualbrainError, MissingDependencyError, UsageError

if TYPE_CHECKING:
    from dualbrain.adaptation.training.process_group import ProcessGroup

DATASET_FOLDER = "dataset"

Flag = Annotated[bool, Parameter(negative="")]


def adapt(
    *,
    robot: str = "panda",
    base: str = "smollm2-135m-instruct",
    ledger: Path | None = None,
    site: Path | None = None,
    config: Path | None = None,
    out: Path | None = None,
    export: Path | None = None,
    dry_run: Flag = False,
    when_idle: Flag = False,
    json: Flag = False,
) -> int:
    """Learn from what went well: choose the clean episodes of a robot and fit an adapter of the planner on them.

    Clean are believed successes of this robot and vocabulary with little intervention, not slower than their kind; not
    one in which a person's hand was. Nothing in memory is changed. The adapter is used by nobody until it is promoted.
    Interrupted in any way, the same command with the same --out goes on where it was; which folder that is is told.
    Exit code 1 if the adapter is there, but what it was taught could not be written into the ledger; the same command
    then writes that alone. A
    launcher such as torchrun can start it in several processes, which share each step.

    Parameters
    ----------
    robot
        Whose planner.
    base
        The model that is adapted: from `dualbrain models list`, or base-135m.
    ledger
        Which memory; default in dualbrain's home.
    site
        The site file that the robot ran with: what it did there teaches, too, if the gate accepts it there.
    config
        A TOML file with the dials.
    out
        Where data set, checkpoints and adapter go; default a new folder under runs.
    export
        Write the data set there (JSON lines in prompt-completion form, and its card), and fit nothing.
    dry_run
        Only say what would be used, and what not and why.
    when_idle
        Fit only while the robot rests, the machine has little to do and no battery runs down; halted at once else.
    json
        Print one JSON object on stdout.
    """
    if dry_run and export is not None:
        raise UsageError("--dry-run and --export", got="both", allowed="one: a dry run writes nothing")
    if is_distributed() and (dry_run or export or when_idle):
        raise ConfigurationError(
            "adapt in several processes", got="--dry-run, --export or --when-idle", allowed="a fit"
        )
    from dualbrain.adaptation.adapters.base_models import require_base_model

    require_base_model(base)
    folder = out or Path("runs") / f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}-adapt"
    if when_idle and not (dry_run or export):
        from dualbrain.cli.adapters.adapt_when_idle import adapt_when_idle

        with announce_folder(folder, StderrConsole()):
            return adapt_when_idle(
                robot=robot, base=base, ledger=ledger, site=site, config=config, out=folder, json=json
            )
    from dualbrain.adaptation.config import AdaptConfig, read_config
    from dualbrain.grounding.vocabulary import load_skill_registry, skill_registry_at_site

    dials, registry = read_config(config) if config else AdaptConfig(), load_skill_registry(robot)
    there = skill_registry_at_site(robot, site) if site else None
    if dry_run or export is not None:
        return _curate_only(ledger, registry, there, dials, export, json=json)
    with process_group(import_trainer, out) as team, announce_folder(folder, console_of(team)):
        team.run_on_first(lambda: _write_dataset(ledger, registry, there, dials, folder))
        return _fit(dials, registry, base, folder, ledger, team, json=json)


@contextmanager
def announce_folder(folder: Path, console: StderrConsole) -> Generator[None]:
    """Tell in which `folder` everything is kept, and on Ctrl-C how to go on there."""
    _print_unwrapped(console, f"all is kept in {folder}")
    try:
        yield
    except KeyboardInterrupt:
        _print_unwrapped(console, f"the same command with --out {shlex.quote(str(folder))} goes on")
        raise


def _print_unwrapped(account: StderrConsole, words: str) -> None:
    """Print `words` as they are, on one line however long, so that a path or a command can be copied."""
    account.print(words, markup=False, soft_wrap=True)


def _curate_only(ledger: Path | None, registry: Any, there: Any, dials: Any, export: Path | None, *, json: bool) -> int:
    """Tell what would be taught; write it to `export`, if that is named."""
    from dualbrain.adaptation.curation.dataset import write_dataset

    dataset = _curate(ledger, registry, there, dials, json=json)
    if export is not None:
        write_dataset(dataset, export)
    return ExitCode.SUCCESS


def _write_dataset(ledger: Path | None, registry: Any, there: Any, dials: Any, folder: Path) -> None:
    """Write the data set into `folder`, unless it is there already, of this ledger and by these dials."""
    from dualbrain.adaptation.curation.dataset import read_dataset_card, write_dataset

    if (folder / DATASET_FOLDER / "dataset.json").is_file():
        _require_same_dataset(read_dataset_card(folder / DATASET_FOLDER), dials, folder, ledger, there)
        StderrConsole().print(f"going on with the data set in {folder}")
    else:
        write_dataset(_curate(ledger, registry, there, dials, json=False), folder / DATASET_FOLDER)


def _require_same_dataset(card: Any, dials: Any, folder: Path, ledger: Path | None, there: Any) -> None:
    """Raise `InvalidSetup` if the data set of `card` was chosen by other dials, from another ledger or site."""
    from dualbrain.adaptation.curation.dataset import curation_differences
    from dualbrain.memory.ledger.hash_chain import Head
    from dualbrain.memory.state.history import descends_from

    if others := curation_differences(card, dials.curation):
        fix = "Name another --out to choose anew, or the dials of before to go on."
        raise ConfigurationError(
            f"[curation] of the data set in {folder}", got=others, allowed="what it was made by", fix=fix
        )
    if card.site != (site := there.hash if there else ""):
        got, allowed = (hash[:16] or "none" for hash in (site, card.site))
        fix = "Name another --out to choose anew, or the --site of before to go on."
        raise ConfigurationError(f"site of the data set in {folder}", got=got, allowed=allowed, fix=fix)
    with open_reader(ledger) as opened:
        if not descends_from(opened, Head(card.event, card.ledger)):
            allowed = f"the one whose event {card.event} is {card.ledger[:16]}"
            fix = "Name another --out to choose anew, or with --ledger the memory of before to go on."
            raise ConfigurationError(
                f"ledger of the data set in {folder}", got=str(opened.path), allowed=allowed, fix=fix
            )


def _curate(ledger: Path | None, registry: Any, there: Any, dials: Any, *, json: bool) -> Any:
    """The data set of the ledger, told on stderr, or on stdout as JSON; `there` is the vocabulary at a site."""
    from dualbrain.adaptation.curation.curate import curate
    from dualbrain.adaptation.curation.dataset import assemble_dataset

    with open_reader(ledger) as opened:
        curated = curate(opened, registry, dials.curation, site=there)
    dataset = assemble_dataset(curated, registry, dials.curation, site=there)
    if json:
        print_json({"card": dataset.card, "left_out": curated.left_out, "samples": _sample_fields(curated)})
    else:
        _print_dataset(dataset.card, curated)
    return dataset


def _fit(
    dials: Any, registry: Any, base: str, folder: Path, ledger: Path | None, team: ProcessGroup, *, json: bool
) -> int:
    """Fit an adapter on the data set in `folder`, with its progress on stderr."""
    from dualbrain.adaptation.adapters.base_models import find_base_model
    from dualbrain.adaptation.compliance import make_gate_judge
    from dualbrain.adaptation.curation.dataset import read_dataset

    dataset = read_dataset(folder / DATASET_FOLDER)
    if dataset.card.registry != registry.hash:
        got, fix = dataset.card.registry, "The vocabulary has changed since: choose anew, with another --out."
        raise ConfigurationError("registry of the data set", got=got, allowed=registry.hash, fix=fix)
    night = import_trainer()
    account = console_of(team)
    card = night.adapt(
        dataset,
        dials,
        find_base_model(base, cache_folder()),
        make_gate_judge(registry),
        folder,
        cache=cache_folder(),
        clock=time.monotonic,
        tell=lambda progress: account.print(format_step(progress)),
        team=team,
        own=_unbootstrapped_adapters(),
    )
    return team.run_on_first(lambda: _register_adapter(card, dataset, folder, ledger, json=json))


def _unbootstrapped_adapters() -> list[str]:
    """Ids of the adapters here that their base alone has taught; of one that cannot be read nothing is known."""
    from dualbrain.cli.adapters.registry import open_adapter_registry

    registry = open_adapter_registry()
    whole = [one for one, fault in registry.verify().items() if not fault]
    return [one for one in whole if not registry.card(one).bootstrapped]


def _register_adapter(card: Any, dataset: Any, folder: Path, ledger: Path | None, *, json: bool) -> ExitCode:
    """Register the adapter in `folder`, say so and what comes next; no success if nobody could note what taught it."""
    from dualbrain.adaptation.adapters.registry import place_of_card
    from dualbrain.cli.adapters.registry import open_adapter_registry

    registry, account = open_adapter_registry(), StderrConsole()
    registry.add(folder / "adapter", now=time.time())
    noted = _record_in_ledger(card, dataset, folder, ledger)
    account.print(f"adapter {card.id[:16]}; used by nobody until it is promoted. Next, in this order:")
    for line in _next_commands(card, folder, ledger, alone=not registry.champion(place_of_card(card))):
        _print_unwrapped(account, f"  {line}")
    if json:
        print_json(card)
    return ExitCode.SUCCESS if noted else ExitCode.FAILED_SAFELY


def _next_commands(card: Any, folder: Path, ledger: Path | None, *, alone: bool) -> tuple[str, ...]:
    """The commands that lead a new adapter into service, in their order; `alone` if none serves in its place yet."""
    from dualbrain.planner.registry import DEFAULT_PLANNER

    one, results = card.id[:16], folder / "measured.json"
    data, told = (shlex.quote(str(path)) for path in (folder / DATASET_FOLDER, results))
    of = f" --ledger {shlex.quote(str(ledger))}" if ledger else ""
    return (
        f"dualbrain adapters measure {one} --data {data} --out {told}{of}",
        f'dualbrain run "…" --robot {card.robot} --planner shadow:{one}{f"@{DEFAULT_PLANNER}" if alone else ""}',
        f"dualbrain adapters promote {one} --measured {told}",
    )


def _record_in_ledger(card: Any, dataset: Any, folder: Path, ledger: Path | None) -> bool:
    """Write into the ledger which memories the adapter was taught, so that an audit finds what a bad one reached.

    The adapter is there already: that this cannot be written is told with what to do, and undoes nothing.
    """
    from dualbrain.cli.memory.open_memory import open_memory
    from dualbrain.memory.maintenance.edits import record_adapter

    names = sorted({name for row in dataset.train for name in row.memories})
    try:
        with open_memory(ledger, writing="adapt") as opened:
            record_adapter(opened, card.id, card.dataset, names, now=time.time())
    except DualbrainError as error:
        StderrConsole().print(f"not written into the ledger: {error}", markup=False)
        StderrConsole().print(
            f"Until it is, an audit does not find which memories adapter {card.id[:16]} was taught. Give the same "
            f"command again, with --out {folder}: it takes no further step, and writes that.",
            markup=False,
        )
        return False
    return True


def import_trainer() -> Any:
    """What fits adapters; raises `MissingPart` where the extra is not installed."""
    try:
        from dualbrain.adaptation.training import train as night
    except ModuleNotFoundError as error:
        fix = "Install it with `pip install 'dualbrain[adapt]'`."
        raise MissingDependencyError(f"{error.name}, of the extra `adapt`,", fix=fix) from error
    return night


def format_step(progress: Any) -> str:
    """One step for a person."""
    words = f"step {progress.step}/{progress.steps}  loss {progress.cross_entropy:.3f}  KL {progress.divergence:.4f}"
    if progress.held_out is not None:
        asked, loss = progress.held_out.compliance, progress.held_out.loss
        words += f"  held out: {'' if asked is None else f'{asked:.0%} compliant, '}loss {loss:.3f}"
    return f"{words}  {progress.seconds_left / 60.0:.1f} min left"


def _sample_fields(curated: Any) -> list[dict[str, Any]]:
    parts = (("train", curated.train), ("held_out", curated.held_out))
    fields = ("id", "memory", "events", "weight", "Delta", "duration", "repeats", "scene", "source", "contract")
    return [{"part": part, **{name: getattr(row, name) for name in fields}} for part, rows in parts for row in rows]


def _print_dataset(card: Any, curated: Any) -> None:
    told = StderrConsole()
    heads, rows = ("id", "part", "memory", "events", "Δ", "w", "shown", "contract"), list[tuple[str, ...]]()
    for row in _sample_fields(curated):
        numbers = (f"{row['Delta']:.4f}", f"{row['weight']:.2f}", f"{row['repeats']}×")
        steps = row["contract"].partition('"action_sequence":')[2].removesuffix("}")
        events = " ".join(str(event) for event in row["events"])
        rows.append((row["id"][:8], row["part"], row["memory"], events, *numbers, steps[:60]))
    told.print(format_table(heads, rows, wrap_columns=("events", "contract")), markup=False, soft_wrap=True)
    for reason, count in card.left_out.items():
        told.print(f"left out: {count} {reason}")
    told.print(
        f"data set {card.hash[:16]}: {card.train} samples to train on ({card.shown} shown an epoch), {card.held_out} "
        f"held out, {card.scenes} scenes; {card.merged} near-duplicates merged, of {card.memories} memories up to "
        f"event {card.event}"
    )
