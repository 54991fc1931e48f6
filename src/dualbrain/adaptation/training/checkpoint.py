"""Where a fit stands: one file, replaced by one atomic step, so that it is whole whenever a process is killed."""

# pyright: reportMissingImports=false

from __future__ import annotations

import hashlib
from pathlib import Path

import msgspec
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from dualbrain.adaptation.config import FitDials, ObjectiveDials
from dualbrain.adaptation.early_stopping import Patience
from dualbrain.adaptation.training.checksummed_tensors import Damaged, packed, unpacked
from dualbrain.core.storage.atomic_files import write_durably
from dualbrain.core.text import apart
from dualbrain.errors import UNREADABLE, InvalidSetup

ANEW = "Name another --out, or delete it to begin anew."


class Mark(msgspec.Struct, frozen=True):
    """`run` is the key of what is being fitted, `step` the last one taken, `patience` the best so far.

    `best` is the SHA-256 of the best adapter's file, `told` are the parts of the run; older marks have neither.
    """

    run: str
    step: int
    patience: Patience
    best: str = ""
    told: dict[str, str] = {}


def save_checkpoint(path: Path, mark: Mark, tensors: dict[str, Tensor]) -> None:
    """Write `tensors` and `mark`; raises `DiskFull`, and then the former checkpoint still stands."""
    write_durably(path, packed(tensors, {"mark": msgspec.json.encode(mark).decode()}))


def load_checkpoint(path: Path, run: Run) -> tuple[Mark, dict[str, Tensor]] | None:
    """The checkpoint at `path`, None if there is none; raises `InvalidSetup` if it is of another run or damaged."""
    if not path.is_file():
        return None
    fix = f"{ANEW} {path}"
    try:
        tensors, facts = unpacked(path)
        mark = msgspec.json.decode(facts.get("mark", ""), type=Mark)
    except (Damaged, *UNREADABLE) as error:
        raise InvalidSetup("checkpoint", got=f"damaged: {error}", allowed="a whole one", fix=fix) from error
    if mark.run != run.key:
        parts = apart(mark.told, run.told)
        got = "one of other data, dials or base" + (f" ({parts})" if parts else "")
        raise InvalidSetup("checkpoint", got=got, allowed="of this run", fix=fix)
    return mark, tensors


def save_best(path: Path, adapter: dict[str, Tensor]) -> str:
    """Write the best adapter so far; returns the SHA-256 of the file. Raises `DiskFull`."""
    data = save(adapter)
    write_durably(path, data)
    return hashlib.sha256(data).hexdigest()


def load_best(path: Path, sha256: str) -> dict[str, Tensor]:
    """The adapter that `save_best` wrote; raises `InvalidSetup` if it is not that any more ("": nobody knows)."""
    try:
        data = path.read_bytes()
        if sha256 and hashlib.sha256(data).hexdigest() != sha256:
            raise Damaged("it is not what was written")
        return load(data)
    except (OSError, Damaged, SafetensorError) as error:
        fix = f"Name another --out, or delete the folder's checkpoint to begin anew. {path}"
        raise InvalidSetup(
            "best adapter of the fit", got=f"damaged: {error}", allowed="a whole one", fix=fix
        ) from error


class Run(msgspec.Struct, frozen=True):
    """Hashes of the data set and of the base, the number format that is computed in, and the dials."""

    data: str
    base: str
    numbers: str
    objective: ObjectiveDials
    fit: FitDials

    @property
    def key(self) -> str:
        """A name for it all."""
        told = [self.data, self.base, self.numbers, msgspec.to_builtins(self.objective), msgspec.to_builtins(self.fit)]
        return hashlib.sha256(msgspec.json.encode(told)).hexdigest()[:32]

    @property
    def told(self) -> dict[str, str]:
        """Each part by its name, for people."""
        dials = {"objective": msgspec.to_builtins(self.objective), "fit": msgspec.to_builtins(self.fit)}
        parts = {"data set": self.data[:16], "base": self.base[:16], "numbers": self.numbers}
        return parts | {f"{room} {name}": str(value) for room, some in dials.items() for name, value in some.items()}
