"""Balance over skills and rare cases: a sample is as rare as its rarest attribute, and rare samples are repeated.

No sample is discarded. The square root is between the natural frequencies and equal frequencies of all attributes (the
tempering that multilingual models use for languages, Conneau et al. 2020, section 3.1, there with exponent 0.3).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from dualbrain.adaptation.curation.candidate import Candidate
from dualbrain.contracts.contract import Action
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import ChoiceParameter


def compute_repeats(candidates: Sequence[Candidate], registry: SkillRegistry, max_repeats: int) -> list[int]:
    """Repetitions per epoch of every candidate: round(√(N / n_a)), at most `max_repeats`; a is its rarest attribute.

    n_a of the N samples have attribute a: a skill, a choice of a parameter (`approach=tilted`), or a scene symbol of an
    object that the contract names. An attribute of half of all samples gives one repetition. Law: a rarer sample is
    never repeated less often.
    """
    tables = [sample_attributes(one, registry) for one in candidates]
    counts = Counter(attribute for table in tables for attribute in table)
    rarest = [min((counts[attribute] for attribute in table), default=len(candidates)) for table in tables]
    return [min(max_repeats, max(1, round(math.sqrt(len(candidates) / n)))) for n in rarest]


def sample_attributes(candidate: Candidate, registry: SkillRegistry) -> frozenset[str]:
    """The attributes of `candidate` by which its rarity is counted."""
    actions = candidate.contract.action_sequence if candidate.contract else ()
    named = {str(value) for action in actions for value in action.params.values() if isinstance(value, str)}
    chosen = {choice for action in actions for choice in _choices(action, registry)}
    return frozenset({*candidate.skill_sequence, *chosen, *_symbols(candidate.summary, named)})


def _choices(action: Action, registry: SkillRegistry) -> list[str]:
    parameters = registry.skill(action.skill).parameters
    names = [p.name for p in parameters if isinstance(p, ChoiceParameter) and p.name in action.params]
    return [f"{action.skill}.{name}={action.params[name]}" for name in names]


def _symbols(summary: str, named: set[str]) -> set[str]:
    """The scene symbols of the `named` objects and of people, without names."""
    found: set[str] = set()
    for line in summary.splitlines():
        name, _, rest = line.partition(":")
        if name in named or name == "person":
            found |= {f"{'person ' if name == 'person' else ''}{part.strip()}" for part in rest.split(",")}
    return found - {"", "object", "container"}
