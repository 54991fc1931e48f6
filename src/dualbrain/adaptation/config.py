"""All settings of adaptation, read from one TOML file: `[curation]`, `[objective]`, `[fit]`; each has a default."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal, TypeVar

import msgspec

from dualbrain.adaptation.curation.curate import CurationConfig
from dualbrain.core.untrusted.bounded_file import read_bounded_file
from dualbrain.core.untrusted.toml_document import TomlFault, parse_toml
from dualbrain.errors import ConfigurationError

Settings = TypeVar("Settings", bound=msgspec.Struct)
MAX_FILE_BYTES = 1 << 20
"""Largest size of a settings file."""

EntropyGate = Literal["none", "sample", "token"]
"""Effect of entropy on the loss: none, the paper's weight per sample, or EAFT's weight per token."""


class ObjectiveConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the objective: λ_w, λ_H of ω_i = 1 + λ_w ŵ_i + λ_H Ĥ_i, β of the KL term, and the entropy gate.

    `lambda_h` has an effect with the gate "sample" only.
    """

    lambda_w: float = 0.5
    lambda_h: float = 0.5
    beta: float = 0.05
    entropy_gate: EntropyGate = "sample"

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for a negative or infinite parameter: ω ≥ 1 and β ≥ 0 as in the paper."""
        for name in ("lambda_w", "lambda_h", "beta"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise ConfigurationError(f"objective {name}", got=value, allowed="at least 0 and finite")


MAX_SEED = 2**63 - 1
"""The largest seed that all random generators accept."""
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
"""Lower and upper bound of each integer setting of training; beyond them a library would fail during training."""


class FitConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of training.

    `steps` optimiser steps of `batch` samples, `at_once` of them in one forward pass. The learning rate rises to `rate`
    over `warm_up` steps and then falls along a cosine to a tenth of it. `clip` bounds the gradient norm. `rank` and
    `alpha` are r and α of LoRA. Every `save_every` steps a checkpoint is written and the held-out part is evaluated (on
    at most `ask_at_most` questions); training stops after `patience` evaluations without improvement. `keep` "best"
    keeps the adapter of the best evaluation; "last" takes all steps, keeps the last adapter and evaluates it once.
    `seed` initialises adapter and order of samples; `threads` is the number of processor threads (0: one). `precision`
    "auto" is bf16 if the device multiplies in bf16, else float32. `quantise` "nf4" keeps the frozen layers in 4 bits
    (QLoRA).
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
        """Raise `ConfigurationError` for a setting that is out of bounds."""
        for name, (least, most) in INTEGER_BOUNDS.items():
            if not least <= (got := getattr(self, name)) <= most:
                raise ConfigurationError(f"fit {name}", got=got, allowed=f"{least} to {most}")
        for name in ("rate", "clip"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ConfigurationError(f"fit {name}", got=getattr(self, name), allowed="above 0 and finite")
        if self.batch % self.at_once:
            raise ConfigurationError("fit at_once", got=self.at_once, allowed=f"a divisor of batch = {self.batch}")


class AdaptConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All settings that determine data set and training; stored beside the resulting adapter."""

    curation: CurationConfig = CurationConfig()
    objective: ObjectiveConfig = ObjectiveConfig()
    fit: FitConfig = FitConfig()


def read_config(path: Path) -> AdaptConfig:
    """The settings in the TOML file at `path`; `ConfigurationError` names a wrong or unknown setting."""
    fix = "Use the settings of `[curation]`, `[objective]` and `[fit]`."
    return read_settings(path, AdaptConfig, "The adaptation config", fix)


def read_settings(path: Path, kind: type[Settings], name: str, fix: str) -> Settings:
    """The settings `kind` in the TOML file at `path`, called `name` in messages; raises as `read_config`."""
    fix = f"{fix} {path}"
    tables = parse_toml(read_bounded_file(path, MAX_FILE_BYTES))
    if isinstance(tables, TomlFault):
        raise ConfigurationError.stating(f"{name} cannot be read: {tables.problem}.", fix=fix)
    try:
        return msgspec.convert(tables, kind)
    except msgspec.ValidationError as error:
        raise ConfigurationError.stating(f"{name} cannot be read: {error}.", fix=fix) from error
