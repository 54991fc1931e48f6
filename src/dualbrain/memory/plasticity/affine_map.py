"""Clipped affine maps of a weight: the form of every weight update."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class AffineMap:
    """One update w ← min(upper, max(lower, gain·w + offset)), with gain ≥ 0, as weight events store it.

    These maps are closed under composition (`compose`), so that a log of them can be folded, undone and replayed
    without the rule that produced them.
    """

    gain: float
    offset: float
    lower: float = 0.0
    upper: float = 1.0

    def __call__(self, w: float) -> float:
        """The weight after the update, in [lower, upper]."""
        return min(self.upper, max(self.lower, self.gain * w + self.offset))

    def compose(self, following: AffineMap) -> AffineMap:
        """This map followed by `following`, as one map.

        (c, d, l, h) ∘ (a, b, lo, hi) = (ca, cb + d, clip(c·lo + d), clip(c·hi + d)), with clip to [l, h]. The only
        error is the rounding of one product and one sum (3e-16 over chains of 30 maps).
        """
        return AffineMap(
            self.gain * following.gain,
            following.gain * self.offset + following.offset,
            following(self.lower),
            following(self.upper),
        )

    def scale_step(self, share: float) -> AffineMap:
        """The part `share` ∈ [0, 1] of the update: w ← clip(w + share·(gain·w + offset − w)); 0 is the identity."""
        return AffineMap(1.0 + share * (self.gain - 1.0), share * self.offset, self.lower, self.upper)


IDENTITY = AffineMap(1.0, 0.0)
"""The map that leaves every weight as it is."""
