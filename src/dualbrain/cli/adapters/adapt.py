"""`dualbrain adapt`: curate a data set from the ledger and train an adapter on it."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from dualbrain.cli.adapters import training
from dualbrain.cli.adapters.process_launcher import console_of, is_distributed, process_group
from dualbrain.cli.adapters.training import DATASET_FOLDER, announce_folder
from dualbrain.cli.common.console import StderrConsole, format_table
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.memory.open_memory import open_reader, print_json
from dualbrain.errors import ConfigurationError, DualbrainError, UsageError

if TYPE_CHECKING:
    from dualbrain.adaptation.training.process_group import ProcessGroup
    from dualbrain.memory.ledger.ledger import LedgerReader

Flag = Annotated[bool, Parameter(negative="")]
MAX_NAMED_MEMORIES = 5
"""Largest number of memories that an error names."""


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
    """Train an adapter of the planner on the clean episodes of a robot.

    Clean episodes are confirmed successes of this robot and skill vocabulary with little intervention that were not
    unusually slow and had no operator takeover. The memory is not changed. The adapter is not used before its
    promotion. An interrupted run resumes with the same command and the same --out; the command prints that folder.
    Exit code 1 means that the adapter is complete, but its training data could not be recorded in the ledger; the same
    command then only records it. A launcher such as torchrun can start the command in several processes, which share
    each step.

    Parameters
    ----------
    robot
        The robot that the planner is adapted to.
    base
        The base model: from `dualbrain models list`, or base-135m.
    ledger
        The memory ledger; default in dualbrain's home.
    site
        The site file of the robot: episodes at the site are used too, if its gate accepts their contracts.
    config
        A TOML file with the settings of curation, objective and training.
    out
        The folder for data set, checkpoints and adapter; default a new folder under runs.
    export
        Write the data set to this folder (JSON lines in prompt-completion form, and its card) and do not train.
    dry_run
        Only print which episodes would be used and why others are excluded.
    when_idle
        Train only while the robot is idle, the machine has little load and runs on mains power; else pause at once.
    json
        Print one JSON object on stdout.
    """
    if dry_run and export is not None:
        problem = "--dry-run and --export exclude each other: a dry run writes nothing."
        raise UsageError.stating(problem, fix="Leave one of them out.")
    if is_distributed() and (dry_run or export or when_idle):
        problem = "Several processes cannot run adapt with --dry-run, --export or --when-idle."
        raise ConfigurationError.stating(problem, fix="Start it without a launcher.")
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

    settings, registry = read_config(config) if config else AdaptConfig(), load_skill_registry(robot)
    at_site = skill_registry_at_site(robot, site) if site else None
    if dry_run or export is not None:
        return _curate_only(ledger, registry, at_site, settings, export, json=json)
    with process_group(training.import_trainer, out) as group, announce_folder(folder, console_of(group)):
        group.run_on_first(lambda: _write_dataset(ledger, registry, at_site, settings, folder))
        return _fit(settings, registry, base, folder, ledger, group, json=json)


def _curate_only(
    ledger: Path | None, registry: Any, at_site: Any, settings: Any, export: Path | None, *, json: bool
) -> int:
    """Print the data set, and write it to `export` if that is named."""
    from dualbrain.adaptation.curation.dataset import write_dataset

    dataset = _curate(ledger, registry, at_site, settings, json=json)
    if export is not None:
        write_dataset(dataset, export)
    return ExitCode.SUCCESS


def _write_dataset(ledger: Path | None, registry: Any, at_site: Any, settings: Any, folder: Path) -> None:
    """Write the data set to `folder`, unless one of the same ledger and settings is there already."""
    from dualbrain.adaptation.curation.dataset import read_dataset_card, write_dataset

    if (folder / DATASET_FOLDER / "dataset.json").is_file():
        _require_same_dataset(read_dataset_card(folder / DATASET_FOLDER), settings, folder, ledger, at_site)
        StderrConsole().print(f"using the data set in {folder}", markup=False)
    else:
        write_dataset(_curate(ledger, registry, at_site, settings, json=False), folder / DATASET_FOLDER)


def _require_same_dataset(card: Any, settings: Any, folder: Path, ledger: Path | None, at_site: Any) -> None:
    """Raise `ConfigurationError` if the data set of `card` has other settings or prompts, another ledger or site."""
    from dualbrain.adaptation.curation.dataset import curation_differences
    from dualbrain.memory.ledger.anchors import descends_from
    from dualbrain.memory.ledger.hash_chain import Head
    from dualbrain.planner.prompt.short_prompt import short_template_hash

    if others := curation_differences(card, settings.curation):
        fix = "Name another --out to curate again, or use the former settings to resume."
        problem = f"The data set in {folder} was made with other settings of [curation]: {others}."
        raise ConfigurationError.stating(problem, fix=fix)
    if card.prompt != (present := short_template_hash()):
        problem = f"The data set in {folder} has the prompt template {card.prompt}, but the present one is {present}."
        raise ConfigurationError.stating(problem, fix="Name another --out to curate again.")
    if card.site != (site := at_site.hash if at_site else ""):
        here, there = (f"the site {hash[:16]}" if hash else "no site" for hash in (site, card.site))
        fix = "Name another --out to curate again, or the former --site to resume."
        problem = f"The data set in {folder} was made for {there}, but {here} is given."
        raise ConfigurationError.stating(problem, fix=fix)
    with open_reader(ledger) as opened:
        if not descends_from(opened, Head(card.event, card.ledger)):
            problem = f"The data set in {folder} is of another ledger than {opened.path}: its event {card.event} is"
            fix = "Name another --out to curate again, or the former ledger with --ledger to resume."
            raise ConfigurationError.stating(f"{problem} {card.ledger[:16]}.", fix=fix)
        _require_same_robots(card, opened.usable_writers, folder)
        _require_memories_in_use(folder, opened)


def _require_same_robots(card: Any, usable: tuple[str, ...], folder: Path) -> None:
    """Raise `ConfigurationError` unless the data set of `card` is from the `usable` robots of a shared ledger."""
    if card.use_memories_of is not None and set(card.use_memories_of) != set(usable):
        there, here = (", ".join(sorted(names)) or "all robots" for names in (card.use_memories_of, usable))
        problem = f"The data set in {folder} was made from the memories of {there}; now those of {here} are to be used."
        fix = "Name another --out to curate again, or restore `use_memories_of` in the file of the ledger to resume."
        raise ConfigurationError.stating(problem, fix=fix)


def _require_memories_in_use(folder: Path, ledger: LedgerReader) -> None:
    """Raise `ConfigurationError` if a sample in `folder` is of a memory that is no longer in use, for example poisoned.

    A complete adapter is accepted: nothing is trained then, and the ledger records what it was trained on.
    """
    from dualbrain.adaptation.adapters.card import CARD_FILE
    from dualbrain.adaptation.curation.dataset import read_dataset
    from dualbrain.memory.state.derivation import derive_state

    if (folder / training.ADAPTER_FOLDER / CARD_FILE).is_file():
        return
    state, dataset = derive_state(ledger), read_dataset(folder / DATASET_FOLDER)
    names = sorted({row.memory for row in (*dataset.train, *dataset.held_out)})
    excluded = [one for one in names if one not in state or state[one].status in ("quarantined", "forgotten")]
    if excluded:
        shown = ", ".join(excluded[:MAX_NAMED_MEMORIES]) + (", …" if len(excluded) > MAX_NAMED_MEMORIES else "")
        problem = f"The data set in {folder} contains memories that were quarantined, forgotten or rolled back since:"
        raise ConfigurationError.stating(f"{problem} {shown}.", fix="Name another --out to curate again.")


def _curate(ledger: Path | None, registry: Any, at_site: Any, settings: Any, *, json: bool) -> Any:
    """The data set of the ledger, printed on stderr, or on stdout as JSON; `at_site` is the vocabulary of a site."""
    from dualbrain.adaptation.curation.curate import curate
    from dualbrain.adaptation.curation.dataset import assemble_dataset

    with open_reader(ledger) as opened:
        curated = curate(opened, registry, settings.curation, site=at_site)
    dataset = assemble_dataset(curated, registry, settings.curation, site=at_site)
    if json:
        print_json({"card": dataset.card, "left_out": curated.left_out, "samples": _sample_fields(curated)})
    else:
        _print_dataset(dataset.card, curated)
    return dataset


def _fit(
    settings: Any, registry: Any, base: str, folder: Path, ledger: Path | None, group: ProcessGroup, *, json: bool
) -> int:
    """Train an adapter on the data set in `folder`, and register it."""
    from dualbrain.adaptation.compliance import make_gate_judge
    from dualbrain.adaptation.curation.dataset import read_dataset

    dataset = read_dataset(folder / DATASET_FOLDER)
    if dataset.card.registry != registry.hash:
        problem = f"The data set has the vocabulary {dataset.card.registry}, but that of the robot is {registry.hash}."
        raise ConfigurationError.stating(problem, fix="The vocabulary has changed: curate again with another --out.")
    judge, own = make_gate_judge(registry), _unbootstrapped_adapters()
    card = training.train_adapter(base, settings, judge, folder, group, dataset=dataset, own_adapters=own)
    return group.run_on_first(lambda: _finish(card, dataset, folder, ledger, json=json))


def _unbootstrapped_adapters() -> list[str]:
    """Ids of the registered adapters that were trained only on proposals of their base; damaged ones are left out."""
    from dualbrain.cli.adapters.registry import open_adapter_registry

    registry = open_adapter_registry()
    intact = [one for one, fault in registry.verify().items() if not fault]
    return [one for one in intact if not registry.card(one).bootstrapped]


def _finish(card: Any, dataset: Any, folder: Path, ledger: Path | None, *, json: bool) -> ExitCode:
    """Register the adapter in `folder`; exit code 1 if the ledger was not updated."""
    training.register_adapter(folder)
    is_recorded = _record_in_ledger(card, dataset, folder, ledger)
    training.print_next_commands(card, folder, ledger=ledger)
    if json:
        print_json(card)
    return ExitCode.SUCCESS if is_recorded else ExitCode.FAILED_SAFELY


def _record_in_ledger(card: Any, dataset: Any, folder: Path, ledger: Path | None) -> bool:
    """Record in the ledger which memories the adapter was trained on, so that an audit can trace a bad memory.

    The adapter is complete already: a failure is reported with its remedy and undoes nothing.
    """
    from dualbrain.cli.memory.open_memory import open_memory
    from dualbrain.memory.maintenance.edits import record_adapter

    names = sorted({name for row in dataset.train for name in row.memories})
    try:
        with open_memory(ledger, writing="adapt") as opened:
            record_adapter(opened, card.id, card.dataset, names, now=time.time())
    except DualbrainError as error:
        StderrConsole().print(f"not recorded in the ledger: {error}", markup=False)
        StderrConsole().print(
            f"An audit cannot find which memories adapter {card.id[:16]} was trained on. Repeat the same command with "
            f"--out {folder}: it takes no further step and only records them.",
            markup=False,
        )
        return False
    return True


def _sample_fields(curated: Any) -> list[dict[str, Any]]:
    parts = (("train", curated.train), ("held_out", curated.held_out))
    fields = ("id", "memory", "events", "weight", "Delta", "duration", "repeats", "scene", "source", "contract")
    return [{"part": part, **{name: getattr(row, name) for name in fields}} for part, rows in parts for row in rows]


def _print_dataset(card: Any, curated: Any) -> None:
    console = StderrConsole()
    headers, rows = ("id", "part", "memory", "events", "Δ", "w", "shown", "contract"), list[tuple[str, ...]]()
    for row in _sample_fields(curated):
        numbers = (f"{row['Delta']:.4f}", f"{row['weight']:.2f}", f"{row['repeats']}×")
        steps = row["contract"].partition('"action_sequence":')[2].removesuffix("}")
        events = " ".join(str(event) for event in row["events"])
        rows.append((row["id"][:8], row["part"], row["memory"], events, *numbers, steps[:60]))
    console.print(format_table(headers, rows, wrap_columns=("events", "contract")), markup=False, soft_wrap=True)
    for reason, count in card.left_out.items():
        console.print(f"left out: {count} {reason}", markup=False)
    console.print(
        f"data set {card.hash[:16]}: {card.train} samples to train on ({card.shown} shown an epoch), {card.held_out} "
        f"held out, {card.scenes} scenes; {card.merged} near-duplicates merged, of {card.memories} memories up to "
        f"event {card.event}"
    )
