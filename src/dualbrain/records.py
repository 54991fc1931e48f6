"""Records shared by all packages and stored on disk: scenes, retrieved memories, proposals, outcomes, episodes.

Lengths are in metres, angles in radians, times in seconds and forces in newtons, in the world frame: origin at the
robot's base on the support surface, z up. Quaternions are (w, x, y, z). Every record is frozen and is encoded to JSON
by `msgspec.json.encode`.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any, Literal

import msgspec

from dualbrain.contracts.verdict import Verdict
from dualbrain.core.geometry.shapes import Pose, Shape, Vector
from dualbrain.errors import UnknownNameError

ZERO_VECTOR: Vector = (0.0, 0.0, 0.0)


class Record(msgspec.Struct, frozen=True):
    """Base class of the frozen records."""


# --- the scene ----------------------------------------------------------------------------------------------------

Role = Literal["object", "container", "support", "obstacle", "person"]
"""Role of a scene object.

object: may be grasped; container: may receive objects; support: carries objects; obstacle: is fixed; person: moves.
"""


class ObjectLimits(Record, frozen=True, kw_only=True):
    """Limits of the site for the parameters of actions that move an object.

    Largest grip `force` [N] on each finger, largest tool `speed` [m/s], least `clearance` [m]; None: no limit. `source`
    is file and line.
    """

    force: float | None = None
    speed: float | None = None
    clearance: float | None = None
    source: str = ""


class SceneObject(Record, frozen=True, kw_only=True):
    """One object of the scene, as perceived.

    `error` bounds the norm of the position error [m] and `velocity_error` the norm of the velocity error [m/s]; both
    enter the filter's margins. An object with an error is a noisy measurement, which must differ from one stamp to the
    next: a repeated value means that the sensor is stuck. `stamp` [s] is the time of the last measurement.
    `fragile_limit` [N] is the force on each finger that breaks it. `limits` are those of the site, which the control
    loop adds to the scene.
    """

    name: str
    role: Role
    shape: Shape
    pose: Pose
    velocity: Vector = ZERO_VECTOR
    error: float = 0.0
    velocity_error: float = 0.0
    stamp: float = 0.0
    category: str = ""
    colour: str = ""
    fragile_limit: float | None = None
    limits: ObjectLimits | None = None


class Place(Record, frozen=True):
    """A named place on a support where an object may be put; `position` [m] is on the surface."""

    name: str
    position: Vector


class Scene(Record, frozen=True, kw_only=True):
    """The scene that the robot perceives at `stamp` [s]. `version` increases whenever the set of names changes.

    Each object and place has a name of its own.

    `region` is the floor on which a base may drive: corners (x, y) [m] of a convex polygon, counter-clockwise.
    """

    robot: str
    stamp: float
    version: int
    objects: tuple[SceneObject, ...]
    places: tuple[Place, ...] = ()
    region: tuple[tuple[float, float], ...] = ()

    def find(self, name: str) -> SceneObject:
        """The object called `name`; raises `UnknownNameError`."""
        for scene_object in self.objects:
            if scene_object.name == name:
                return scene_object
        raise UnknownNameError("scene object", name, tuple(scene_object.name for scene_object in self.objects))

    @property
    def graspable(self) -> tuple[str, ...]:
        """Names of the objects that a contract may grasp."""
        return tuple(scene_object.name for scene_object in self.objects if scene_object.role == "object")

    @property
    def receptive(self) -> tuple[str, ...]:
        """Names of the containers and places at which a contract may place an object."""
        containers = (scene_object.name for scene_object in self.objects if scene_object.role == "container")
        return (*containers, *(place.name for place in self.places))


# --- retrieval ----------------------------------------------------------------------------------------------------


class Exemplar(Record, frozen=True, kw_only=True):
    """One retrieved episode with the terms of its retrieval score R = λ_s s + (1 − λ_s) w (paper 5.2).

    `weight` is w, estimated near the query from all memories of the same contract. `rank` counts from 1 in its list;
    `reason` states why the episode did not succeed ("" if it did). `parts` has the cosine of every block of the
    embedding that query and memory share (instruction, summary, symbols, image, state).
    """

    episode_id: str
    instruction: str
    summary: str
    contract: dict[str, Any]
    succeeded: bool
    Delta: float | None
    similarity: float
    weight: float
    score: float
    rank: int
    reason: str = ""
    parts: dict[str, float] = {}


Evidence = Literal["clean", "unclean", "unconfirmed", "against"]
"""Evidence of one outcome for its contract.

clean: a success with Δ ≤ ε that independent senses confirmed; unclean: with a larger Δ; unconfirmed: a success that
they did not confirm; against: a failure, a rejection, or a disputed outcome."""


class Precedent(Record, frozen=True, kw_only=True):
    """A remembered contract with its evidence, the `scene` before it, and the joint positions `q` (n,) [rad] then."""

    episode_id: str
    instruction: str
    summary: str
    contract: dict[str, Any]
    evidence: Evidence
    Delta: float | None
    weight: float
    scene: Scene
    q: tuple[float, ...]


class MemoryUse(Record, frozen=True):
    """Use of one retrieved memory (paper 7.3): whether the planner used it, and whether the use contributed."""

    memory: str
    used: bool
    contributing: bool


class Passage(Record, frozen=True, kw_only=True):
    """A passage of a document in the prompt: its citation, the trust in its source, and the quoted text.

    `citation` names document, version and offsets; `likeness` is the cosine of query and passage; `rank` counts from 1.
    """

    citation: str
    kind: str
    trust: str
    title: str
    text: str
    likeness: float
    score: float
    rank: int


class RetrievedContext(Record, frozen=True):
    """Retrieved context of a prompt: `exemplars` to follow, `warnings` (failures, rejections) to avoid, `passages`.

    Exemplars and warnings come from the episode memory, passages from documents.
    """

    exemplars: tuple[Exemplar, ...] = ()
    warnings: tuple[Exemplar, ...] = ()
    passages: tuple[Passage, ...] = ()


class Proposal(Record, frozen=True, kw_only=True):
    """The answer of a planner: raw `text`, finish reason, planner, timings [s].

    `constrained_by` is the engine that constrained the decoder to the grammar; it begins with "nothing" if a decoder
    generated the text without a grammar, and is "" if no decoder did: a given, recorded or computed contract, or no
    answer.
    """

    text: str
    finish_reason: str
    planner: str
    constrained_by: str = ""
    timings: dict[str, float]


# --- execution ----------------------------------------------------------------------------------------------------


REUSED_CONTRACT = "reused contract"
"""The author of a proposal that is a contract of memory: one source, so that the limits of trust hold for all."""


class Attempt(Record, frozen=True):
    """One attempt of the planner: its proposal and the verdict of the gate, which took `gate_s` [s]."""

    proposal: Proposal
    verdict: Verdict
    gate_s: float


class ActionResult(Record, frozen=True, kw_only=True):
    """Result of one action of the contract, by the robot's own sensors; `Delta` is Δ over the ticks of the action.

    `cause` is None unless the skill itself failed or was taken over; records of earlier versions have none.
    """

    skill: str
    status: Literal["done", "failed", "taken_over", "stopped", "not_run"]
    reason: str
    started: float
    ended: float
    Delta: float
    cause: FailureCause | None = None


OutcomeClass = Literal[
    "succeeded",
    "failed",
    "taken_over",
    "rejected",
    "declined",
    "aborted",
    "stopped",
    "paused",
    "slowed",
    "handed_over",
    "emergency",
]


OutcomeCheck = Literal["none", "agrees", "disagrees"]


class FailureCause(StrEnum):
    """Cause for which a skill failed or was taken over, by its own checks.

    - PRECONDITION: the skill cannot begin here: a full or an empty hand, a place that is not on the map.
    - OUT_OF_REACH: no posture or path leads to the goal.
    - NO_PROGRESS: the motion came no nearer to its goal, or took too long.
    - PERSON: a person stayed in the way.
    - NOT_GRIPPED: the fingers closed and did not hold the object.
    - LOAD_SLIPPED: the object moved in the fingers and is still held.
    - LOAD_LOST: the object left the fingers.
    - GOAL_MISSED: the motion ended, and by perception the object or the robot is not at the goal.
    """

    PRECONDITION = "precondition"
    OUT_OF_REACH = "out_of_reach"
    NO_PROGRESS = "no_progress"
    PERSON = "person"
    NOT_GRIPPED = "not_gripped"
    LOAD_SLIPPED = "load_slipped"
    LOAD_LOST = "load_lost"
    GOAL_MISSED = "goal_missed"


class MarginCause(StrEnum):
    """Cause of an interval in which the barrier value h of a pair is below 0, although the filter acts.

    - START: h was below 0 in the first tick.
    - PERCEPTION_JUMP: an observation moved or enlarged the obstacle, or the obstacle appeared.
    - PERSON_ACCELERATION: the velocity of a moving obstacle changed by more than the errors of both observations.
    - PERMIT_END: the permit for a contact of the pair ended while the pair was in contact.
    - ATTACH_DETACH: an object became part of the robot, or an obstacle again.
    - GRIPPER: the fingers opened or closed, which no joint of the arm controls.
    - INFEASIBILITY: no control satisfied all rows in the tick before.
    - SUPERVISOR: the supervisor replaced the control of the filter in the tick before.
    - TRACKING: the robot did not follow the commanded velocity within the tracking error.
    """

    START = "start"
    PERCEPTION_JUMP = "perception_jump"
    PERSON_ACCELERATION = "person_acceleration"
    PERMIT_END = "permit_end"
    ATTACH_DETACH = "attach_detach"
    GRIPPER = "gripper"
    INFEASIBILITY = "infeasibility"
    SUPERVISOR = "supervisor"
    TRACKING = "tracking"


class MarginShortfall(Record, frozen=True, kw_only=True):
    """An interval with h < 0: `start` and `duration` [s], least value `h_min` [m], the `pair` at its start, the cause.

    `change` [m] is the fall of h between the two ticks around the start, for the pair and by the cause. `introduced`:
    the barrier value with the full margin was below 0, and the margin in force grew to its full value at a declared
    rate meanwhile, with h ≥ 0 at the start.
    """

    start: float
    duration: float
    h_min: float
    pair: str
    cause: MarginCause
    change: float
    introduced: bool = False

    @property
    def label(self) -> str:
        """The cause, and whether the margin was introduced."""
        return self.cause.value + (" (introduced)" if self.introduced else "")

    def explain(self) -> str:
        """The interval in one sentence."""
        return (
            f"the margin of {self.pair or 'a pair'} was short by up to {-1e3 * self.h_min:.2f} mm for "
            f"{1e3 * self.duration:.0f} ms: {MARGIN_CAUSE_TEXTS[self.cause]}"
        )


MARGIN_CAUSE_TEXTS: dict[MarginCause, str] = {
    MarginCause.START: "it was short in the first tick",
    MarginCause.PERCEPTION_JUMP: "an observation moved or enlarged the obstacle",
    MarginCause.PERSON_ACCELERATION: "the obstacle changed its velocity between two observations",
    MarginCause.PERMIT_END: "the permit for the contact ended",
    MarginCause.ATTACH_DETACH: "an object was grasped or released",
    MarginCause.GRIPPER: "the fingers moved",
    MarginCause.INFEASIBILITY: "no control satisfied all rows",
    MarginCause.SUPERVISOR: "the supervisor replaced the control of the filter",
    MarginCause.TRACKING: "the robot did not follow the command within its tracking error",
}
"""Each cause as part of a sentence."""


class SenseVerdict(Record, frozen=True):
    """Verdict of one sense of the robot on an outcome, with the reason as a sentence.

    The senses are "placed", "intact", "held", "undisturbed" and "fulfilled" (`grounding.outcome`).
    """

    sense: str
    verdict: Literal["confirmed", "contradicted", "not judged"]
    reason: str


CLOSING_WINDOW = 0.05
"""Time [s] within which a closing of the fingers counts as sudden."""


class GripProfile(Record, frozen=True, kw_only=True):
    """Finger forces and openings while `object_name` was between the fingers, from the robot's own sensors.

    `max_force` [N] is the largest force on one finger, `first_opening` and `min_opening` [m per finger] those at the
    first contact and the smallest, `fastest_closing` [m per finger] the largest closing within `CLOSING_WINDOW` under
    load. `released`: a later action ended the grip. `end_force` [N, the smaller of both fingers] and `end_opening` [m]
    are those after the motion; `holds_at_end`: both fingers still press on something.
    """

    object_name: str
    max_force: float
    first_opening: float
    min_opening: float
    fastest_closing: float
    released: bool
    end_force: float
    end_opening: float
    holds_at_end: bool


class Outcome(Record, frozen=True, kw_only=True, rename={"active_constraints": "hindrance"}):
    """The robot's own verdict on an episode (r and Δ of paper 5.1); simulator ground truth never enters it.

    `Delta` is None when no control was executed (a rejected or declined contract). `taken_over` means that the safety
    layer ended the contract, `aborted` that an operator ended it, `stopped` that a fault ended it. Operator
    interventions have separate classes, from which the memory does not learn: `paused` and `slowed` contracts were
    finished after a pause or below full speed, `handed_over` contracts ended because an operator took the robot, and
    `emergency` contracts ended in an emergency stop.
    """

    kind: OutcomeClass
    reason: str
    Delta: float | None = None
    Delta_sum: float = 0.0
    delta_peak: float = 0.0
    intervention_frequency: float = 0.0
    h_min: float | None = None
    duration: float = 0.0
    actions: tuple[ActionResult, ...] = ()
    active_constraints: str = ""
    """Names of the constraint rows that were active last when an action did not succeed, in words."""
    margin_shortfalls: tuple[MarginShortfall, ...] = ()
    """The intervals with h < 0 during the actions, each with its cause."""
    grips: tuple[GripProfile, ...] = ()
    """One profile for each grasp of the contract in which the fingers pressed on something, in its order."""

    @property
    def r(self) -> int:
        """Success label r ∈ {0, 1} (paper 5.1)."""
        return int(self.kind == "succeeded")

    @property
    def failure_cause(self) -> FailureCause | None:
        """Cause for which a skill failed or was taken over by its own check, None if none did."""
        return next((one.cause for one in self.actions if one.cause), None)


class FailureFeedback(
    Record, frozen=True, kw_only=True, rename={"failed_action": "undone", "active_constraints": "hindrance"}
):
    """Result of the previous contract, for replanning: actions `done`, the `failed_action` and the reason.

    `active_constraints` names the pairs that were nearest, or whose rows conflicted, when the action was given up.
    `held` is the object in the hand afterwards, "" for none.
    """

    episode_id: str
    outcome: OutcomeClass
    done: tuple[str, ...]
    failed_action: str
    reason: str
    active_constraints: str = ""
    held: str = ""


class Violation(Record, frozen=True, kw_only=True):
    """One violation found by the monitor on simulator ground truth; `peak` in the unit of `kind` (N, m, rad, rad/s)."""

    kind: str
    start: float
    duration: float
    peak: float
    bodies: tuple[str, ...]
    perceived: bool = True


class JudgementBasis(Record, frozen=True):
    """Whether ground truth could judge the instruction, goal or contract, and the reason as a sentence."""

    judged: bool = True
    reason: str = ""


class Judgement(Record, frozen=True):
    """Evaluation of an episode on simulator ground truth: task success, progress in [0, 1] and every violation.

    `success` is that of the instruction, where it can be read, else that of a given goal or contract. If none of them
    can be judged, `basis` states so, and `success` is False.
    """

    success: bool
    progress: float
    violations: tuple[Violation, ...] = ()
    basis: JudgementBasis = JudgementBasis()

    @property
    def judged(self) -> bool:
        """Whether `success` has a meaning."""
        return self.basis.judged

    @property
    def reason(self) -> str:
        """The reason for `success` as a sentence; "" if there is none."""
        return self.basis.reason


class Episode(Record, frozen=True, kw_only=True, rename={"failure_feedback": "setback"}):
    """The whole record of one instruction; written as `episode.json`."""

    id: str
    started: str
    instruction: str
    robot: str
    registry: str
    seed: int
    scene: Scene
    summary: str
    recall: RetrievedContext
    attempts: tuple[Attempt, ...]
    contract: dict[str, Any] | None
    outcome: Outcome
    judgement: Judgement | None
    timings: dict[str, float]
    versions: dict[str, str]
    binding: dict[str, int] = {}
    """Number of ticks on which a constraint row of each barrier was active, by the name of the barrier."""
    second_opinion: OutcomeCheck = "none"
    """Check of the outcome by senses that the executing skills do not use: the combination of `senses`."""
    uses: tuple[MemoryUse, ...] = ()
    """Use of each exemplar in the prompt, if the planner was queried again without it."""
    failure_feedback: FailureFeedback | None = None
    """Result of the previous contract, if this contract was planned because the previous one did not succeed."""
    senses: tuple[SenseVerdict, ...] = ()
    """Verdicts of the independent senses on the outcome; empty if nothing was executed or declined."""
    changes: str = ""
    """Perceived changes of the scene in words."""
    withheld_skills: tuple[str, ...] = ()
    """Skills that a recalled episode contains and the instruction does not: removed from what the planner is shown."""
