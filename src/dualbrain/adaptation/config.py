"""All dials of adaptation, from one TOML file: `[curation]`, `[objective]`, `[fit]`; the rest has its default."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import msgspec

from dualbrain.adaptation.curation.curate import CurationConfig
from dualbrain.errors import DECODE_ERRORS, ConfigurationError

EntropyGate = Literal["none", "sample", "token"]
"""What entropy does to the loss: nothing; the paper's weight of a sample; EAFT's weight of a token."""


class ObjectiveConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """λ_w `lambda_w` and λ_H `lambda_h` of ω_i = 1 + λ_w ŵ_i + λ_H Ĥ_i, β `beta` of the KL term, and the entropy gate.

    `lambda_h` is used by the gate "sample" only.
    """

    lambda_w: float = 0.5
    lambda_h: float = 0.5
    beta: float = 0.05
    entropy_gate: EntropyGate = "sample"

    def __post_init__(self) -> None:
        """Raise `InvalidSetup` for a negative or endless dial: ω ≥ 1 and β ≥ 0 as in the paper."""
        for name in ("lambda_w", "lambda_h", "beta"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ConfigurationError(f"objective {name}", got=value, allowed="at least 0 and finite")


MAX_SEED = 2**63 - 1
"""The largest seed that every source of chance takes."""
INTEGER_BOUNDS = {
    "steps": (1, 1_000_000),
    "batch": (1, 4096),
    "at_once": (1, 4096),
    "rank": (1, 1024),
    "alpha": (1, 65_536),
    "save_every": (1, 1_000_000),
    "patience": (1, 1_000_000),
    "warm_up": (0, 1_000_000),
    "ask_at_most": (0, 1_000_000),
    "seed": (0, MAX_SEED),
    "threads": (0, 4096),
}
"""Least and most of each whole number of a fit. Beyond them no fit is meant, and a library would fail in its midst."""


class FitConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How long and how fast.

    `steps` optimiser steps of `batch` samples, `at_once` of them in one forward pass. The rate rises to `rate` over
    `warm_up` steps and falls along a cosine to a tenth of it. `clip` bounds the norm of the gradient. `rank` and
    `alpha` are LoRA's r and α. Every `save_every` steps a checkpoint is written, and the held-out part is asked (at
    most `ask_at_most` questions); after `patience` rounds without progress it stops. `keep` the best of them, or the
    last, whatever it is, after all steps: then it is asked once, at the end. `precision` "auto" is bf16 where the
    device multiplies in it, else float32. `quantise` "nf4" keeps the frozen layers in 4 bits (QLoRA).
    """

    steps: int = 120
    batch: int = 8
    at_once: int = 8
    rate: float = 1e-3
    warm_up: int = 10
    clip: float = 1.0
    rank: int = 8
    alpha: int = 16
    save_every: int = 20
    ask_at_most: int = 24
    patience: int = 3
    keep: Literal["best", "last"] = "best"
    seed: int = 0
    threads: int = 0
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    quantise: Literal["none", "nf4"] = "none"

    def __post_init__(self) -> None:
        """Raise `InvalidSetup` for what cannot be."""
        for name, (least, most) in INTEGER_BOUNDS.items():
            if not least <= (got := getattr(self, name)) <= most:
                raise ConfigurationError(f"fit {name}", got=got, allowed=f"{least} to {most}")
        for name in ("rate", "clip"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ConfigurationError(f"fit {name}", got=getattr(self, name), allowed="above 0 and finite")
        if self.batch % self.at_once:
            raise ConfigurationError("fit at_once", got=self.at_once, allowed=f"a divisor of batch = {self.batch}")


class AdaptConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that decides what is taught and how; written beside the adapter it made."""

    curation: CurationConfig = CurationConfig()
    objective: ObjectiveConfig = ObjectiveConfig()
    fit: FitConfig = FitConfig()


def read_config(path: Path) -> AdaptConfig:
    """The dials in the TOML file at `path`; raises `InvalidSetup` naming the dial that is wrong or unknown."""
    try:
        return msgspec.toml.decode(path.read_bytes(), type=AdaptConfig)
    except DECODE_ERRORS as error:
        raise ConfigurationError(
            "adaptation config",
            got=str(error),
            allowed="the dials of `[curation]`, `[objective]`, `[fit]`",
            fix=str(path),
        ) from error
