"""What a fit is a fit of: all that decides its result. Nothing else is taken up in the same folder."""

from __future__ import annotations

import hashlib

import msgspec

from dualbrain.adaptation.config import FitDials, ObjectiveDials


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
