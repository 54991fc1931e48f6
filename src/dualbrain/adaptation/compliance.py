"""Compliance: whether the gate accepts an unconstrained answer of a planner, and the share of such answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from dualbrain.adaptation.curation.sample import Sample
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.verdict import Accepted

AnswerJudge = Callable[[str, Sample], bool]
"""Whether a text is a valid answer to the prompt of a sample."""


def make_gate_judge(registry: SkillRegistry) -> AnswerJudge:
    """A judge that accepts what syntax, authorization, bounds and scene names of the gate allow, but no `decline`.

    The robot executed the contract of every sample, so declining is wrong; otherwise a planner would comply by never
    acting. The gate's rules on geometry and robot (order of grasp and place, opening, reach, free floor:
    `grounding/envelope/scene_rules.py`) are not checked, because a sample contains neither; they are checked at
    execution and in the experiments `language` and `rounds`.
    """
    gate = Gate(registry, {"planner": frozenset(registry.by_name)})

    def accepts(text: str, sample: Sample) -> bool:
        verdict = gate.check(
            text.encode("utf-8", "surrogatepass"), names=sample.scene_names, principal="planner", now=0.0
        )
        return isinstance(verdict, Accepted) and all(a.skill != "decline" for a in verdict.contract.action_sequence)

    return accepts


def compliant_share(judge: AnswerJudge, answers: Sequence[str], samples: Sequence[Sample]) -> float:
    """The share of `answers` that `judge` accepts, in [0, 1]."""
    return sum(judge(text, sample) for text, sample in zip(answers, samples, strict=True)) / max(1, len(samples))
