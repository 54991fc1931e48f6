"""Where a fit stands: one file, replaced by one atomic step, so that it is whole whenever a process is killed."""

# pyright: reportMissingImports=false

from __future__ import annotations

from pathlib import Path

import msgspec
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from dualbrain.adaptation.durable import write_durably
from dualbrain.adaptation.patience import Patience
from dualbrain.errors import InvalidSetup


class Mark(msgspec.Struct, frozen=True):
    """`run` names what is being fitted (data, dials, base), `step` the last one taken, `patience` the best so far."""

    run: str
    step: int
    patience: Patience


def save_checkpoint(path: Path, mark: Mark, tensors: dict[str, Tensor]) -> None:
    """Write `tensors` and `mark`; raises `DiskFull`, and then the former checkpoint still stands."""
    whole = {name: tensor.detach().contiguous().cpu() for name, tensor in tensors.items()}
    write_durably(path, save(whole, {"mark": msgspec.json.encode(mark).decode()}))


def load_checkpoint(path: Path, run: str) -> tuple[Mark, dict[str, Tensor]] | None:
    """The checkpoint at `path`, None if there is none; raises `InvalidSetup` if it is of another run or damaged."""
    if not path.is_file():
        return None
    fix = f"Name another --out, or delete it to begin anew. {path}"
    try:
        with safe_open(path, "pt") as file:
            mark = msgspec.json.decode((file.metadata() or {}).get("mark", ""), type=Mark)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, msgspec.DecodeError) as error:
        raise InvalidSetup("checkpoint", got=f"damaged: {error}", allowed="a whole one", fix=fix) from error
    if mark.run != run:
        raise InvalidSetup("checkpoint", got="one of other data, dials or base", allowed="of this run", fix=fix)
    return mark, tensors
