"""Judge of an instruction on simulator ground truth; for simulation and evaluation only, never for the robot.

It compares exact scenes with the goal that `read_goal` reads from the words, by the same relations as the robot's own
sense. The robot's evidence is perceived, this one is exact, so the two differ by perception and touch, not by rules: an
error of the goal parser is common to both, and must be measured with instructions whose goal is known from elsewhere.
"""

from __future__ import annotations

import msgspec

from dualbrain.grounding.instruction.goals.goal import Unread
from dualbrain.grounding.instruction.goals.goal_reading import read_goal
from dualbrain.grounding.outcome.evidence import Evidence, arm_home, base_position
from dualbrain.grounding.outcome.sense_fulfilled import judge_fulfilled
from dualbrain.records import Judgement, JudgementBasis
from dualbrain.simulation.tasks.true_episode import InstructionJudge, InstructionVerdict, TrueEpisode

SUCCESS_OF_VERDICT = {"confirmed": True, "contradicted": False, "not judged": None}


def make_instruction_judge(instruction: str) -> InstructionJudge | None:
    """The judge of the words of `instruction`; None without words."""
    if not instruction.strip():
        return None

    def judge(episode: TrueEpisode) -> InstructionVerdict:
        verdict = judge_fulfilled(read_goal(instruction, episode.before), exact_evidence(episode))
        return InstructionVerdict(SUCCESS_OF_VERDICT[verdict.verdict], verdict.reason)

    return judge


def exact_evidence(episode: TrueEpisode) -> Evidence:
    """The evidence about `episode` without errors."""
    return Evidence(
        before=episode.before,
        after=episode.after,
        q_before=episode.q_before,
        q_after=episode.q_after,
        home=arm_home(episode.robot_model),
        base_after=base_position(episode.robot_model, episode.q_after),
        in_hand=episode.in_hand,
        in_hand_before=episode.in_hand_before,
        touched=episode.touched,
        unsettled=episode.unsettled,
        broken=episode.broken,
    )


def judge_decline(judgement: Judgement | None, instruction: str, evidence: Evidence) -> Judgement | None:
    """`judgement` of an instruction that was declined: a success if it was to be declined, else none.

    The simulated world does not know that a planner or a local check declined; it sees only that nothing moved.
    """
    if judgement is None or not evidence.declined or not instruction.strip():
        return judgement
    goal = read_goal(instruction, evidence.before)
    if isinstance(goal, Unread):
        return msgspec.structs.replace(judgement, success=False, basis=JudgementBasis(judged=False, reason=goal.reason))
    verdict = judge_fulfilled(goal, evidence)
    success = verdict.verdict == "confirmed"
    return msgspec.structs.replace(judgement, success=success, basis=JudgementBasis(judged=True, reason=verdict.reason))
