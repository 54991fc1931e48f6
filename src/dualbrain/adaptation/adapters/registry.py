"""The registry of adapters: one folder per adapter, named by the hash of its weights, and a log of all changes."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import msgspec

from dualbrain.adaptation.adapters.card import (
    CARD_FILE,
    CONFIG_FILE,
    METADATA_FILES,
    WEIGHTS_FILE,
    AdapterCard,
    hash_metadata_files,
    read_adapter_card,
    read_lora_config,
    require_metadata_files,
)
from dualbrain.adaptation.adapters.promotion import PromotionDecision
from dualbrain.core.storage.atomic_files import FileWriteError
from dualbrain.core.storage.file_lock import file_lock
from dualbrain.core.storage.private_files import open_private, open_private_folder, private_folder
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, DualbrainError, UnknownNameError

LOG_FILE, LOCK_FILE = "journal.jsonl", ".lock"
ADAPTER_FILES = (WEIGHTS_FILE, *METADATA_FILES)
NO_ADAPTER = ""
"""The id that denotes the base model without an adapter."""
"""Mode of an adapter's folder: training data of a robot is private to its user (see `dualbrain adapters export`)."""


UNRECORDED_FAULT = (
    "its folder exists, but the registry log has no entry for it: the log was lost or truncated, or a crash happened "
    "before the entry was written. Restore the log from a backup, because it alone records which adapter serves; or "
    "repeat the `dualbrain adapt --out` that wrote the adapter"
)


class RegistryEntry(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the log: a change of `adapter` at `time` [s, 1970 UTC] with its reason and decision.

    `place` is the robot and the hash of the base: each place has one champion. After "rolled back", `adapter` serves
    again. "added" records the SHA-256 of the `files` that the id does not cover; entries of older versions lack them.
    """

    kind: Literal["added", "promoted", "rolled back"]
    adapter: str
    place: tuple[str, str]
    time: float
    reason: str = ""
    decision: PromotionDecision | None = None
    files: dict[str, str] = {}


class AdapterRegistry:
    """All adapters in one folder. Adapters are never changed or deleted, and the log is append-only.

    Promise: a crash, a full disk or a kill at any moment leaves every adapter and the champion as before or as after
    the change. An id always denotes the same content. An adapter is promoted only by a decision of the promotion gate.
    """

    def __init__(self, folder: Path) -> None:
        """Use `folder`; the first `add` creates it."""
        self.folder = folder

    def add(self, source: Path, *, now: float) -> AdapterCard:
        """Copy the adapter in the folder `source` into the registry, unless it is there already.

        Raises `ConfigurationError` for a folder that lacks a file and for weights that are registered with other LoRA
        settings or other card entries than in `source`; `FileWriteError`.
        """
        card = read_adapter_card(source)
        if lacking := [name for name in ADAPTER_FILES if not (source / name).is_file()]:
            fix = f"Name a folder in which training has finished. {source}"
            raise ConfigurationError.stating(f"The adapter folder has no {lacking[0]}.", fix=fix)
        open_private_folder(self.folder)
        with self._exclusive_lock():
            if not (target := self.folder / card.id).is_dir():
                self._copy(source, target)
            elif others := _conflicting_facts(source, target, self.recorded_hashes(card.id)):
                fix = f"An id always denotes one content: train again, or restore the files of these weights. {source}"
                problem = f"The adapter {card.id[:16]} is registered with another {', '.join(others)}."
                raise ConfigurationError.stating(problem, fix=fix)
            if not any(entry.adapter == card.id for entry in self.entries()):
                self._append(
                    RegistryEntry(
                        kind="added",
                        adapter=card.id,
                        place=place_of_card(card),
                        time=now,
                        files=hash_metadata_files(target),
                    )
                )
        return card

    def ids(self) -> tuple[str, ...]:
        """Ids in the order in which the adapters were added."""
        return tuple(entry.adapter for entry in self.entries() if entry.kind == "added")

    def find(self, name: str) -> str:
        """The only id that begins with `name`; raises `UnknownNameError` if there is none or more than one."""
        found = [one for one in self.ids() if name and one.startswith(name)]
        if len(found) != 1:
            raise UnknownNameError("adapter", name, tuple(one[:16] for one in self.ids()), owner="this registry")
        return found[0]

    def adapter_folder(self, name: str) -> Path:
        """The folder of one adapter; raises `ConfigurationError` if its config or card changed after it was added."""
        folder = self.folder / (one := self.find(name))
        require_metadata_files(folder, self.recorded_hashes(one))
        return folder

    def card(self, name: str) -> AdapterCard:
        """The card of one adapter, after its files are verified against the recorded hashes."""
        return read_adapter_card(self.adapter_folder(name))

    def recorded_hashes(self, adapter_id: str) -> dict[str, str]:
        """Hashes of config and card of an adapter when it was added; empty if an older version recorded none."""
        return next(
            (entry.files for entry in self.entries() if (entry.adapter, entry.kind) == (adapter_id, "added")), {}
        )

    def entries(self) -> tuple[RegistryEntry, ...]:
        """All entries, oldest first. An incomplete last line, left by a crash, is ignored."""
        path = self.folder / LOG_FILE
        if not path.is_file():
            return ()
        *lines, _torn = path.read_bytes().split(b"\n")
        try:
            return tuple(msgspec.json.decode(line, type=RegistryEntry) for line in lines)
        except DECODE_ERRORS as error:
            fix = f"Restore it from a backup. {path}"
            raise ConfigurationError.stating(
                f"The log of the adapter registry is damaged: {error}.", fix=fix
            ) from error

    def champion(self, place: tuple[str, str]) -> str:
        """The id of the adapter that serves at `place`; `NO_ADAPTER` if none does."""
        return self._history(place)[-1]

    def serving_ids(self) -> tuple[str, ...]:
        """Ids of the adapters that serve at any place."""
        places = dict.fromkeys(entry.place for entry in self.entries())
        return tuple(one for one in map(self.champion, places) if one != NO_ADAPTER)

    def last_decision(self, adapter_id: str) -> PromotionDecision | None:
        """The decision of the last promotion of an adapter; None if it was never promoted."""
        return next(
            (entry.decision for entry in reversed(self.entries()) if entry.adapter == adapter_id and entry.decision),
            None,
        )

    def promote(self, name: str, decision: PromotionDecision, *, now: float, reason: str = "") -> None:
        """Make `name` the champion of its place, if `decision` compares it with the present champion and is positive.

        `reason` states further conditions that were met or waived. Raises `NotPromotedError` with the reasons, and
        `ConfigurationError` for a decision about other adapters, or if an adapter on another base serves the robot.
        """
        card = self.card(name)
        with self._exclusive_lock():
            self._check_decision(card, decision)
            if not decision.promotes:
                raise NotPromotedError(card.id, decision.against)
            self._require_single_base(place_of_card(card))
            self._append(
                RegistryEntry(
                    kind="promoted",
                    adapter=card.id,
                    place=place_of_card(card),
                    time=now,
                    reason=reason,
                    decision=decision,
                )
            )

    def require_decision_about(self, name: str, decision: PromotionDecision) -> None:
        """Raise `ConfigurationError` unless `decision` compares `name` with the present champion of its place."""
        self._check_decision(self.card(name), decision)

    def _check_decision(self, card: AdapterCard, decision: PromotionDecision) -> None:
        present = self.champion(place_of_card(card))
        if (decision.candidate, decision.champion) != (card.id, present):
            measured = f"{decision.candidate[:16] or 'the bare base'} with {decision.champion[:16] or 'the bare base'}"
            needed = f"{card.id[:16]} with {present[:16] or 'the bare base'}"
            problem = f"The measurement compares {measured}; a promotion needs a comparison of {needed}."
            raise ConfigurationError.stating(problem, fix="Measure again.")

    def _require_single_base(self, place: tuple[str, str]) -> None:
        """Raise `ConfigurationError` if the robot of `place` is served on another base.

        Measurements on two bases cannot be compared.
        """
        places = dict.fromkeys(entry.place for entry in self.entries())
        others = [one for one in places if one[0] == place[0] and one != place and self.champion(one) != NO_ADAPTER]
        if others:
            problem = f"The champion of {place[0]} is {self.champion(others[0])[:16]}, on another base."
            fix = "Roll it back first with `dualbrain adapters rollback`, or select this adapter by its id."
            raise ConfigurationError.stating(problem, fix=fix)

    def roll_back(self, place: tuple[str, str], reason: str, *, now: float) -> str:
        """Let the former champion of `place` serve again and return its id; before the first one, the bare base served.

        A former champion that is damaged is skipped. Raises `ConfigurationError` without a reason, and if no adapter
        serves there.
        """
        if not reason.strip():
            raise ConfigurationError("reason", got=reason, allowed="a few words", fix="State it with --reason.")
        with self._exclusive_lock():
            history = self._history(place)
            if len(history) < 2:
                problem = "No adapter serves there: the bare base does."
                raise ConfigurationError.stating(problem, fix="There is nothing to roll back.")
            for former in reversed(history[:-1]):
                self._append(RegistryEntry(kind="rolled back", adapter=former, place=place, time=now, reason=reason))
                if former == NO_ADAPTER or not (reason := self.find_fault(former)):
                    return former
            return NO_ADAPTER

    def verify(self) -> dict[str, str]:
        """The fault of each adapter, "" if it has none; a folder without an entry in the log is a fault."""
        return {one: self.find_fault(one) for one in self.ids()} | dict.fromkeys(
            self.unrecorded_ids(), UNRECORDED_FAULT
        )

    def unrecorded_ids(self) -> tuple[str, ...]:
        """Ids of the adapters whose folder exists without an entry in the log."""
        known = set(self.ids())
        return tuple(path.name for path in sorted(self.folder.glob("[0-9a-f]" * 64)) if path.name not in known)

    def find_fault(self, adapter_id: str) -> str:
        """The fault of an adapter, "" if it has none."""
        try:
            card = self.card(adapter_id)
        except DualbrainError as error:
            return str(error)
        return "" if card.id == adapter_id else f"its folder holds {card.id[:16]}"

    def _history(self, place: tuple[str, str]) -> list[str]:
        """The champions of `place` in order, without those that were rolled back; the last one serves."""
        stack = [NO_ADAPTER]
        for entry in self.entries():
            if entry.place == place and entry.kind == "promoted":
                stack.append(entry.adapter)
            elif entry.place == place and entry.kind == "rolled back":
                stack.pop()
        return stack

    def _copy(self, source: Path, target: Path) -> None:
        """Copy the files to `target`, all or none."""
        with private_folder(target) as temporary:
            for name in ADAPTER_FILES:
                shutil.copyfile(source / name, temporary / name)
            read_adapter_card(temporary)

    def _append(self, entry: RegistryEntry) -> None:
        """Append one line; an incomplete line that a crash left is cut off first."""
        path = self.folder / LOG_FILE
        try:
            with open_private(path, "a+b", buffering=0) as log:
                log.seek(0)
                end = log.read().rfind(b"\n") + 1
                log.truncate(end)
                line = msgspec.json.encode(entry) + b"\n"
                if log.write(line) != len(line):
                    log.truncate(end)
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(log.fileno())
        except OSError as error:
            raise FileWriteError(path, error) from error

    @contextmanager
    def _exclusive_lock(self) -> Iterator[None]:
        """Hold the registry's lock; raises `ConfigurationError` if there is no registry."""
        if not self.folder.is_dir():
            fix = f"`dualbrain adapt` creates it with its first adapter. {self.folder}"
            raise ConfigurationError.stating("There is no adapter registry.", fix=fix)
        with file_lock(self.folder / LOCK_FILE):
            yield


class NotPromotedError(DualbrainError):
    """The promotion gate decided against a promotion."""

    def __init__(self, adapter: str, reasons: tuple[str, ...]) -> None:
        """Report the adapter and the reasons."""
        self.adapter, self.reasons = adapter, reasons
        super().__init__(f"adapter {adapter[:16]} was not promoted: {'; '.join(reasons)}.")


IDENTITY_FIELDS = (
    *("base", "base_sha256", "robot", "also", "registry", "prompt", "scene_values"),
    *("dataset", "sources", "bootstrapped"),
)
"""Card entries that must agree for equal weights: where and with which prompt the adapter serves, and its training
data. Settings may differ."""


def _conflicting_facts(source: Path, target: Path, recorded: dict[str, str]) -> list[str]:
    """Names of the facts beside equal weights that differ in two folders.

    Raises `ConfigurationError` if `target` was changed.
    """
    kept = read_adapter_card(target)
    require_metadata_files(target, recorded)
    card = read_adapter_card(source)
    config = [] if read_lora_config(source) == read_lora_config(target) else [CONFIG_FILE]
    return config + [f"{name} in {CARD_FILE}" for name in IDENTITY_FIELDS if getattr(kept, name) != getattr(card, name)]


def place_of_card(card: AdapterCard) -> tuple[str, str]:
    """The place (robot, base hash) at which an adapter may serve."""
    return card.robot, card.base_sha256
