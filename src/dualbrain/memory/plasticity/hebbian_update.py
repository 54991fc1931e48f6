"""The bounded Hebbian-style weight update (paper 5.3), with the constraints under which Proposition 2 holds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from dualbrain.errors import ConfigurationError
from dualbrain.memory.plasticity.affine_map import AffineMap

W0 = 0.5
"""Weight of a new memory before any outcome."""
EPSILON = 0.003
"""Default of ε: a success with Δ up to this value reinforces the memories that it used."""
BANDWIDTH = 0.2
"""Default bandwidth ℓ of the neighbourhood: the kernel falls to one half at cos = 0.97."""
MAX_BANDWIDTH = 0.3
"""Largest bandwidth ℓ of the neighbourhood."""


@dataclass(frozen=True, slots=True)
class Penalty:
    """g(Δ) = floor + (1 − floor)·Δ/(Δ + scale): monotone, from `floor` at Δ = 0 to 1; half-way at Δ = `scale`.

    `rejected` replaces g(Δ) for a contract that the gate rejected: it was not executed and has no Δ.
    """

    floor: float = 0.5
    scale: float = 0.01
    rejected: float = 1.0

    def __call__(self, Delta: float | None) -> float:
        """Penalty g(Δ); `rejected` without a Δ, 1 for a Δ that is not finite."""
        if Delta is None:
            return self.rejected
        size = max(Delta, 0.0)
        return self.floor + (1.0 - self.floor) * (size / (size + self.scale) if math.isfinite(Delta) else 1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plasticity:
    """The rule (paper 5.3): ρ `rho`, η₊ `eta_plus`, η₋ `eta_minus`, ε `epsilon` and the penalty `g`.

    reinforce (r = 1 and Δ ≤ ε): w ← min{1, max{0, (1 − ρ)·w + η₊}}
    suppress  (r = 0 or Δ > ε):  w ← min{1, max{0, (1 − ρ)·w − η₋·g(Δ)}}

    Constraints that the paper leaves out and Proposition 2 needs: η₊ ≥ ρ (otherwise a success would lower a high
    weight), η₊ > 0, and η₋·g(0) > 0 or ρ > 0 (otherwise a failure without intervention would change nothing).
    Promise: w stays in [0, 1]; a reinforcement never lowers w, a suppression never raises w, and a larger Δ never
    suppresses less. Under repeated success w → min(1, η₊/ρ) = 1, under repeated failure w → 0. Updates do not commute:
    a replay must keep their order in the ledger. The defaults fit a Δ of about 0.003 in clean successes; set ε per
    robot.

    Neighbourhood: w_j ← min{1, max{0, w_j + κ ξ exp(−‖e_j − e_i‖²/2ℓ²)}} with κ `kappa`, ξ = ±1, ℓ `bandwidth`, for at
    most `reach` memories j ≠ i of the same contract within 3ℓ, where the kernel has fallen to 0.011. ℓ ≤ 0.3, that is
    cos ≥ 0.6: with a larger ℓ, unrelated episodes would be neighbours. κ ≤ η₊ − ρ and κ ≤ η₋·g: the outcome of a
    neighbour never outweighs a memory's own outcome.
    """

    rho: float = 0.05
    eta_plus: float = 0.1
    eta_minus: float = 0.2
    epsilon: float = EPSILON
    g: Penalty = field(default_factory=Penalty)
    kappa: float = 0.02
    bandwidth: float = BANDWIDTH
    reach: int = 100

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for a rule under which Proposition 2 does not hold."""
        g = self.g
        _require("rho", self.rho, 0.0 <= self.rho < 1.0, "in [0, 1)")
        _require(
            "eta_plus", self.eta_plus, max(self.rho, 0.0) <= self.eta_plus < math.inf, f"at least rho = {self.rho}"
        )
        _require("eta_plus", self.eta_plus, self.eta_plus > 0.0, "above 0")
        _require("eta_minus", self.eta_minus, 0.0 <= self.eta_minus < math.inf, "at least 0")
        _require("epsilon", self.epsilon, 0.0 <= self.epsilon < math.inf, "at least 0")
        _require("g.floor", g.floor, 0.0 <= g.floor <= 1.0, "in [0, 1]")
        _require("g.scale", g.scale, 0.0 < g.scale < math.inf, "above 0")
        _require("g.rejected", g.rejected, 0.0 <= g.rejected < math.inf, "at least 0")
        _require("kappa", self.kappa, 0.0 <= self.kappa <= 1.0, "in [0, 1]")
        _require(
            "bandwidth", self.bandwidth, 0.0 < self.bandwidth <= MAX_BANDWIDTH, f"above 0, at most {MAX_BANDWIDTH}"
        )
        _require("reach", self.reach, self.reach >= 0, "at least 0")
        weakest = self.eta_minus * min(g.floor, g.rejected)
        _require("eta_minus * g", weakest, weakest > 0.0 or self.rho > 0.0, "above 0, or rho above 0")
        most = min(self.eta_plus - self.rho, weakest)
        _require("kappa", self.kappa, self.kappa <= max(most, 0.0), f"at most eta_plus - rho and eta_minus * g: {most}")

    def is_reinforcing(self, r: int, Delta: float | None) -> bool:
        """Whether the outcome is a success with 0 ≤ Δ ≤ ε; False if Δ is missing or not finite."""
        return r == 1 and Delta is not None and 0.0 <= Delta <= self.epsilon

    def update_map(self, r: int, Delta: float | None) -> AffineMap:
        """The update of an outcome (r, Δ); Δ is None if nothing was executed."""
        if self.is_reinforcing(r, Delta):
            return AffineMap(1.0 - self.rho, self.eta_plus)
        return AffineMap(1.0 - self.rho, -self.eta_minus * self.g(Delta))

    @property
    def radius(self) -> float:
        """Largest squared distance ‖e_j − e_i‖² of a neighbour, (3ℓ)²."""
        return (3.0 * self.bandwidth) ** 2

    def neighbour_offset(self, distance: float, *, up: bool) -> float:
        """Offset κ ξ exp(−d²/2ℓ²) for the squared distance d² = `distance`; ξ = +1 if `up`, else −1."""
        size = self.kappa * math.exp(-distance / (2.0 * self.bandwidth**2))
        return size if up else -size


def _require(what: str, got: float, holds: bool, allowed: str) -> None:
    if not holds:
        raise ConfigurationError(f"plasticity {what}", got=got, allowed=allowed)
