"""Where a fit stands: one file, replaced by one atomic step, so that it is whole whenever a process is killed."""

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

RESTART_HINT = "Name another --out, or delete it to begin anew."


class CheckpointState(msgspec.Struct, frozen=True, rename={"run_parts": "told"}, kw_only=True):
    """`run` is the key of what is being fitted, `step` the last one taken, `patience` the best so far.

    `best` is the SHA-256 of the best adapter's file, `told` are the parts of the run; older marks have neither.
    """

    run: str
    step: int
    patience: EarlyStopping
    best: str = ""
    run_parts: dict[str, str] = {}


def save_checkpoint(path: Path, state: CheckpointState, tensors: dict[str, Tensor]) -> None:
    """Write `tensors` and `mark`; raises `DiskFull`, and then the former checkpoint still stands."""
    write_atomically(path, encode_tensors(tensors, {"mark": msgspec.json.encode(state).decode()}))


def load_checkpoint(path: Path, run: RunKey) -> tuple[CheckpointState, dict[str, Tensor]] | None:
    """The checkpoint at `path`, None if there is none; raises `InvalidSetup` if it is of another run or damaged."""
    if not path.is_file():
        return None
    fix = f"{RESTART_HINT} {path}"
    try:
        tensors, facts = read_tensors(path)
        mark = msgspec.json.decode(facts.get("mark", ""), type=CheckpointState)
    except (CorruptFileError, *DECODE_ERRORS) as error:
        raise ConfigurationError("checkpoint", got=f"damaged: {error}", allowed="a whole one", fix=fix) from error
    if mark.run != run.digest:
        parts = describe_differences(mark.run_parts, run.parts)
        got = "one of other data, dials or base" + (f" ({parts})" if parts else "")
        raise ConfigurationError("checkpoint", got=got, allowed="of this run", fix=fix)
    return mark, tensors


def save_best(path: Path, adapter: dict[str, Tensor]) -> str:
    """Write the best adapter so far; returns the SHA-256 of the file. Raises `DiskFull`."""
    data = save(adapter)
    write_atomically(path, data)
    return hashlib.sha256(data).hexdigest()


def load_best(path: Path, sha256: str) -> dict[str, Tensor]:
    """The adapter that `save_best` wrote; raises `InvalidSetup` if it is not that any more ("": nobody knows)."""
    try:
        data = path.read_bytes()
        if sha256 and hashlib.sha256(data).hexdigest() != sha256:
            raise CorruptFileError("it is not what was written")
        return load(data)
    except (OSError, CorruptFileError, SafetensorError) as error:
        fix = f"Name another --out, or delete the folder's checkpoint to begin anew. {path}"
        raise ConfigurationError(
            "best adapter of the fit", got=f"damaged: {error}", allowed="a whole one", fix=fix
        ) from error


class RunKey(msgspec.Struct, frozen=True, rename={"number_format": "numbers"}, kw_only=True):
    """Hashes of the data set and of the base, the number format that is computed in, and the dials."""

    data: str
    base: str
    number_format: str
    objective: ObjectiveConfig
    fit: FitConfig

    @property
    def digest(self) -> str:
        """A name for it all."""
        told = [
            self.data,
            self.base,
            self.number_format,
            msgspec.to_builtins(self.objective),
            msgspec.to_builtins(self.fit),
        ]
        return hashlib.sha256(msgspec.json.encode(told)).hexdigest()[:32]

    @property
    def parts(self) -> dict[str, str]:
        """Each part by its name, for people."""
        dials = {"objective": msgspec.to_builtins(self.objective), "fit": msgspec.to_builtins(self.fit)}
        parts = {"data set": self.data[:16], "base": self.base[:16], "numbers": self.number_format}
        return parts | {f"{room} {name}": str(value) for room, some in dials.items() for name, value in some.items()}
