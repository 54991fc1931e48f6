"""The registry of adapters: folders named by the hash of their weights, and a journal of what became of them."""

from __future__ import annotations

import errno
import fcntl
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
from dualbrain.core.storage.atomic_files import FileWriteError, atomic_folder
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, DualbrainError, UnknownNameError

LOG_FILE, LOCK_FILE = "journal.jsonl", ".lock"
ADAPTER_FILES = (WEIGHTS_FILE, *METADATA_FILES)
NO_ADAPTER = ""
"""The id of no adapter: the base as it is."""
FOLDER_MODE = 0o700
"""Mode of an adapter's folder: what a robot was taught is for its own user to show (`dualbrain adapters export`)."""


UNRECORDED_FAULT = (
    "its folder is here, but the journal does not tell of it: that was lost or cut short, or a crash came between. "
    "Put the journal back, for who serves stands there alone; or give the `dualbrain adapt --out` that made this again"
)


class RegistryEntry(msgspec.Struct, frozen=True, kw_only=True):
    """One line of the journal: what was done to `adapter`, at `time` [s, 1970 UTC], why, and on what measurement.

    `place` is robot and hash of the base: each place has one champion. After "rolled back", `adapter` serves again.
    "added" holds the SHA-256 of the `files` that the id does not cover; entries of before that was kept hold none.
    """

    kind: Literal["added", "promoted", "rolled back"]
    adapter: str
    place: tuple[str, str]
    time: float
    reason: str = ""
    decision: PromotionDecision | None = None
    files: dict[str, str] = {}


class AdapterRegistry:
    """All adapters in one folder. Nothing in it is ever changed or deleted; the journal only grows.

    Promise: a crash, a full disk or a kill at any moment leaves every adapter and the champion as before or as after
    it. An id belongs to one content for good. Only what a decision of the gate supports is promoted.
    """

    def __init__(self, folder: Path) -> None:
        """Use `folder`; it is made by the first `add`."""
        self.folder = folder

    def add(self, source: Path, *, now: float) -> AdapterCard:
        """Take in the adapter in the folder `source`; one that is here already stays as it is.

        Raises `InvalidSetup` for a folder that lacks a file, and for weights that are here already but worn otherwise
        or made of other things than `source` says; `DiskFull`.
        """
        card = read_adapter_card(source)
        if lacking := [name for name in ADAPTER_FILES if not (source / name).is_file()]:
            fix = "Name a folder that a fit has finished."
            raise ConfigurationError(
                f"adapter in {source}", got=f"no {lacking[0]}", allowed=", ".join(ADAPTER_FILES), fix=fix
            )
        self.folder.mkdir(parents=True, exist_ok=True)
        with self._exclusive_lock():
            if not (target := self.folder / card.id).is_dir():
                self._copy(source, target)
            elif others := _conflicting_facts(source, target, self.recorded_hashes(card.id)):
                fix = "An id belongs to one content for good: fit anew, or put back what belongs to these weights."
                got = f"the weights of one that is here, with another {', '.join(others)}"
                raise ConfigurationError(f"adapter in {source}", got=got, allowed="what is recorded of them", fix=fix)
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
        """Ids in the order in which they came."""
        return tuple(entry.adapter for entry in self.entries() if entry.kind == "added")

    def find(self, name: str) -> str:
        """The one id that begins with `name`; raises `UnknownName`."""
        found = [one for one in self.ids() if name and one.startswith(name)]
        if len(found) != 1:
            raise UnknownNameError("adapter", name, tuple(one[:16] for one in self.ids()), owner="this registry")
        return found[0]

    def adapter_folder(self, name: str) -> Path:
        """The folder of one adapter; raises `InvalidSetup` if config or card in it are not those that were added."""
        folder = self.folder / (one := self.find(name))
        require_metadata_files(folder, self.recorded_hashes(one))
        return folder

    def card(self, name: str) -> AdapterCard:
        """The card of one adapter, after its files were found to be those that were added."""
        return read_adapter_card(self.adapter_folder(name))

    def recorded_hashes(self, one: str) -> dict[str, str]:
        """Hashes of config and card of the adapter `one` when it was added; none if that was not yet written down."""
        return next((entry.files for entry in self.entries() if (entry.adapter, entry.kind) == (one, "added")), {})

    def entries(self) -> tuple[RegistryEntry, ...]:
        """All entries, oldest first. A last line that was cut off by a crash never happened."""
        path = self.folder / LOG_FILE
        if not path.is_file():
            return ()
        *lines, _torn = path.read_bytes().split(b"\n")
        try:
            return tuple(msgspec.json.decode(line, type=RegistryEntry) for line in lines)
        except DECODE_ERRORS as error:
            raise ConfigurationError(
                "adapter journal", got=str(error), allowed="as it was written", fix=str(path)
            ) from error

    def champion(self, place: tuple[str, str]) -> str:
        """The adapter that serves at `place`, `BARE` if none does."""
        return self._history(place)[-1]

    def serving_ids(self) -> tuple[str, ...]:
        """The adapters that serve anywhere."""
        places = dict.fromkeys(entry.place for entry in self.entries())
        return tuple(one for one in map(self.champion, places) if one != NO_ADAPTER)

    def last_decision(self, one: str) -> PromotionDecision | None:
        """The decision by which the adapter `one` was promoted last, None if it never was."""
        return next(
            (entry.decision for entry in reversed(self.entries()) if entry.adapter == one and entry.decision), None
        )

    def promote(self, name: str, decision: PromotionDecision, *, now: float, reason: str = "") -> None:
        """Make `name` the champion of its place, if `decision` is about it and the present champion, and in favour.

        `reason` tells what else was asked of it, or waived. Raises `NotPromoted` with the reasons, `InvalidSetup` for a
        decision about others, or where an adapter on another base serves the robot.
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
        """Raise `InvalidSetup` if `decision` is not about `name` and the present champion of its place."""
        self._check_decision(self.card(name), decision)

    def _check_decision(self, card: AdapterCard, decision: PromotionDecision) -> None:
        present = self.champion(place_of_card(card))
        if (decision.candidate, decision.champion) != (card.id, present):
            got = f"{decision.candidate[:16] or 'the bare base'} against {decision.champion[:16] or 'the bare base'}"
            allowed = f"{card.id[:16]} against {present[:16] or 'the bare base'}"
            raise ConfigurationError("measured adapters", got=got, allowed=allowed, fix="Measure again.")

    def _require_single_base(self, place: tuple[str, str]) -> None:
        """Raise `InvalidSetup` if the robot of `place` is served on another base: answers of two do not compare."""
        places = dict.fromkeys(entry.place for entry in self.entries())
        others = [one for one in places if one[0] == place[0] and one != place and self.champion(one) != NO_ADAPTER]
        if others:
            got = f"{self.champion(others[0])[:16]} on another base"
            fix = "Roll that back first (`dualbrain adapters rollback`), or name this adapter by its id."
            raise ConfigurationError(
                f"champion of {place[0]}", got=got, allowed="one on the same base, or none", fix=fix
            )

    def roll_back(self, place: tuple[str, str], reason: str, *, now: float) -> str:
        """Give the place back to whom it had before, and return that id; at last to the bare base.

        One that was damaged meanwhile is passed over. Raises `InvalidSetup` if nothing was promoted there.
        """
        if not reason.strip():
            raise ConfigurationError("reason", got=reason, allowed="a few words", fix="Say why with --reason.")
        with self._exclusive_lock():
            history = self._history(place)
            if len(history) < 2:
                raise ConfigurationError("champion", got="the bare base", allowed="a promoted adapter")
            for former in reversed(history[:-1]):
                self._append(RegistryEntry(kind="rolled back", adapter=former, place=place, time=now, reason=reason))
                if former == NO_ADAPTER or not (reason := self.find_fault(former)):
                    return former
            return NO_ADAPTER

    def verify(self) -> dict[str, str]:
        """What is wrong with each adapter, "" if nothing is; a folder that the journal does not tell of is a fault."""
        return {one: self.find_fault(one) for one in self.ids()} | dict.fromkeys(
            self.unrecorded_ids(), UNRECORDED_FAULT
        )

    def unrecorded_ids(self) -> tuple[str, ...]:
        """The adapters whose folder is here without an entry in the journal."""
        known = set(self.ids())
        return tuple(path.name for path in sorted(self.folder.glob("[0-9a-f]" * 64)) if path.name not in known)

    def find_fault(self, one: str) -> str:
        """What is wrong with the adapter `one`, "" if nothing is."""
        try:
            card = self.card(one)
        except DualbrainError as error:
            return str(error)
        return "" if card.id == one else f"its folder holds {card.id[:16]}"

    def _history(self, place: tuple[str, str]) -> list[str]:
        """Who served at `place`, without what was rolled back; the last serves now."""
        stack = [NO_ADAPTER]
        for entry in self.entries():
            if entry.place == place and entry.kind == "promoted":
                stack.append(entry.adapter)
            elif entry.place == place and entry.kind == "rolled back":
                stack.pop()
        return stack

    def _copy(self, source: Path, target: Path) -> None:
        """Bring the files to `target`, all or none."""
        with atomic_folder(target) as beside:
            beside.chmod(FOLDER_MODE)
            for name in ADAPTER_FILES:
                shutil.copyfile(source / name, beside / name)
            read_adapter_card(beside)

    def _append(self, entry: RegistryEntry) -> None:
        """Add one line; what a crash left of a former one is cut off first."""
        path = self.folder / LOG_FILE
        try:
            with path.open("a+b", buffering=0) as journal:
                journal.seek(0)
                whole = journal.read().rfind(b"\n") + 1
                journal.truncate(whole)
                line = msgspec.json.encode(entry) + b"\n"
                if journal.write(line) != len(line):
                    journal.truncate(whole)
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(journal.fileno())
        except OSError as error:
            raise FileWriteError(path, error) from error

    @contextmanager
    def _exclusive_lock(self) -> Iterator[None]:
        """Alone in the registry; raises `InvalidSetup` if there is none."""
        if not self.folder.is_dir():
            fix = "`dualbrain adapt` makes it with its first adapter."
            raise ConfigurationError("registry of adapters", got="none", allowed=str(self.folder), fix=fix)
        with (self.folder / LOCK_FILE).open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield


class NotPromotedError(DualbrainError):
    """The gate measured no reason to promote, or one not to."""

    def __init__(self, adapter: str, reasons: tuple[str, ...]) -> None:
        """Name the adapter and the reasons."""
        self.adapter, self.reasons = adapter, reasons
        super().__init__(f"adapter {adapter[:16]} was not promoted: {'; '.join(reasons)}.")


IDENTITY_FIELDS = ("base", "base_sha256", "robot", "also", "registry", "prompt", "dataset", "sources")
"""What two cards of the same weights say alike: where they may serve, what taught them. Dials and steps may differ."""


def _conflicting_facts(source: Path, target: Path, recorded: dict[str, str]) -> list[str]:
    """What beside equal weights is not the same in two folders; raises `InvalidSetup` if `target` was changed."""
    kept = read_adapter_card(target)
    require_metadata_files(target, recorded)
    card, worn = (
        read_adapter_card(source),
        [] if read_lora_config(source) == read_lora_config(target) else [CONFIG_FILE],
    )
    return worn + [f"{name} in {CARD_FILE}" for name in IDENTITY_FIELDS if getattr(kept, name) != getattr(card, name)]


def place_of_card(card: AdapterCard) -> tuple[str, str]:
    """Where an adapter may serve: with this robot, on this base."""
    return card.robot, card.base_sha256
