"""The checkpoint of a training run: one file, replaced atomically, so it is complete after a kill at any moment."""

# pyright: reportMissingImports=false

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from dualbrain.adaptation.config import FitConfig, ObjectiveConfig
from dualbrain.adaptation.early_stopping import EarlyStopping
from dualbrain.adaptation.training.checksummed_tensors import CorruptFileError, encode_tensors, read_tensors
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.text import describe_differences
from dualbrain.errors import DECODE_ERRORS, ConfigurationError

RESTART_HINT = "Name another --out, or delete it to start again."


class CheckpointState(msgspec.Struct, frozen=True, rename={"run_parts": "told"}, kw_only=True):
    """The state beside the tensors: `run` identifies the run, `step` is the last step, `patience` the early stopping.

    `best` is the SHA-256 of the file of the best adapter, `run_parts` are the parts of the run key; older checkpoints
    have neither.
    """

    run: str
    step: int
    patience: EarlyStopping
    best: str = ""
    run_parts: dict[str, str] = {}


def save_checkpoint(path: Path, state: CheckpointState, tensors: dict[str, Tensor]) -> None:
    """Write `tensors` and `state`; raises `FileWriteError`, and then the former checkpoint is unchanged."""
    write_atomically(path, encode_tensors(tensors, {"mark": msgspec.json.encode(state).decode()}))


def load_checkpoint(path: Path, run: RunKey) -> tuple[CheckpointState, dict[str, Tensor]] | None:
    """The checkpoint at `path`, None if there is none; `ConfigurationError` if it is damaged or of another run."""
    if not path.is_file():
        return None
    fix = f"{RESTART_HINT} {path}"
    try:
        tensors, facts = read_tensors(path)
        state = msgspec.json.decode(facts.get("mark", ""), type=CheckpointState)
    except (CorruptFileError, *DECODE_ERRORS) as error:
        raise ConfigurationError.stating(f"The checkpoint is damaged: {error}.", fix=fix) from error
    if state.run != run.digest:
        parts = describe_differences(state.run_parts, run.parts)
        problem = "The checkpoint is of a run with other data, settings or base" + (f": {parts}." if parts else ".")
        raise ConfigurationError.stating(problem, fix=fix)
    return state, tensors


def save_best(path: Path, adapter: dict[str, Tensor]) -> str:
    """Write the best adapter so far and return the SHA-256 of the file; raises `FileWriteError`."""
    data = save(adapter)
    write_atomically(path, data)
    return hashlib.sha256(data).hexdigest()


def load_best(path: Path, sha256: str) -> dict[str, Tensor]:
    """The adapter that `save_best` wrote; `ConfigurationError` if it changed. `sha256` "" skips the comparison."""
    try:
        data = path.read_bytes()
        if sha256 and hashlib.sha256(data).hexdigest() != sha256:
            raise CorruptFileError("its SHA-256 differs from the recorded one")
        return load(data)
    except (OSError, CorruptFileError, SafetensorError) as error:
        fix = f"Name another --out, or delete the folder's checkpoint to start again. {path}"
        raise ConfigurationError.stating(f"The best adapter of the run is damaged: {error}.", fix=fix) from error


class RunKey(msgspec.Struct, frozen=True, rename={"number_format": "numbers"}, kw_only=True):
    """Identity of a training run: hashes of data set and base, number format of the computation, and settings."""

    data: str
    base: str
    number_format: str
    objective: ObjectiveConfig
    fit: FitConfig

    @property
    def digest(self) -> str:
        """A hash of all parts."""
        parts = [
            self.data,
            self.base,
            self.number_format,
            msgspec.to_builtins(self.objective),
            msgspec.to_builtins(self.fit),
        ]
        return hashlib.sha256(msgspec.json.encode(parts)).hexdigest()[:32]

    @property
    def parts(self) -> dict[str, str]:
        """Each part by its name, for error messages."""
        settings = {"objective": msgspec.to_builtins(self.objective), "fit": msgspec.to_builtins(self.fit)}
        parts = {"data set": self.data[:16], "base": self.base[:16], "numbers": self.number_format}
        return parts | {
            f"{section} {name}": str(value) for section, values in settings.items() for name, value in values.items()
        }
