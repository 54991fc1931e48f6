"""Whether a planner's free answer is a contract that the gate accepts, and how many of them are."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from dualbrain.adaptation.curation.sample import Sample
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.verdict import Accepted

AnswerJudge = Callable[[str, Sample], bool]
"""Whether a text is a sound answer to the prompt of a sample."""


def make_gate_judge(registry: SkillRegistry) -> AnswerJudge:
    """Accepts what syntax, authorization, bounds and the scene's names allow; to decline is no compliant answer here.

    Every sample was done by the robot, so that declining it is wrong; else a planner would comply by never acting. The
    envelope's rules on geometry and body (order of the hand, opening, reach, free floor: `grounding/scene_rules.py`) are not
    asked, for a sample holds neither; they are where a contract is carried out, and in the proofs `language`, `rounds`.
    """
    gate = Gate(registry, {"planner": frozenset(registry.by_name)})

    def accepts(text: str, sample: Sample) -> bool:
        verdict = gate.check(
            text.encode("utf-8", "surrogatepass"), names=sample.scene_names, principal="planner", now=0.0
        )
        return isinstance(verdict, Accepted) and all(a.skill != "decline" for a in verdict.contract.action_sequence)

    return accepts


def compliant_share(judge: AnswerJudge, answers: Sequence[str], samples: Sequence[Sample]) -> float:
    """The share of `answers` that are sound, in [0, 1]."""
    return sum(judge(text, sample) for text, sample in zip(answers, samples, strict=True)) / max(1, len(samples))
