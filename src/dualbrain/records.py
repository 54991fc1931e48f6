"""What crosses rooms and disks: the scene as perceived, what was recalled, what a tick did, how an episode ended.

All lengths are metres, angles radians, times seconds, forces newtons, in the world frame: origin at the robot's base on
the support surface, z up. Quaternions are (w, x, y, z). Every type is frozen and becomes JSON by `msgspec.json.encode`.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from dualbrain.contracts.verdict import Verdict
from dualbrain.core.geometry.shapes import Pose, Shape, Vector
from dualbrain.errors import UnknownNameError

ZERO_VECTOR: Vector = (0.0, 0.0, 0.0)


class Record(msgspec.Struct, frozen=True):
    """Root of the frozen records."""


# --- the scene ----------------------------------------------------------------------------------------------------

Role = Literal["object", "container", "support", "obstacle", "person"]
"""object: may be grasped; container: may receive; support: carries things; obstacle: fixed thing; person: moves."""


class SceneObject(Record, frozen=True, kw_only=True):
    """One thing the robot knows of, as perceived.

    `error` bounds the norm of the position error [m] and `velocity_error` that of the velocity error [m/s]; both enter
    the filter's margins; what has an error is noisy, and never told twice alike under two stamps. `stamp` [s] is when
    it was last seen.
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


class Place(Record, frozen=True):
    """A named spot on a support where a thing may be put; `position` [m] is on the surface."""

    name: str
    position: Vector


class Scene(Record, frozen=True, kw_only=True):
    """What the robot perceives at `stamp` [s]. `version` rises whenever the set of names changes.

    `region` is the floor that a base may drive on: corners (x, y) [m] of a convex polygon, counter-clockwise.
    """

    robot: str
    stamp: float
    version: int
    objects: tuple[SceneObject, ...]
    places: tuple[Place, ...] = ()
    region: tuple[tuple[float, float], ...] = ()

    def find(self, name: str) -> SceneObject:
        """The object called `name`; raises `UnknownName`."""
        for thing in self.objects:
            if thing.name == name:
                return thing
        raise UnknownNameError("scene object", name, tuple(thing.name for thing in self.objects))

    @property
    def graspable(self) -> tuple[str, ...]:
        """Names that a contract may grasp."""
        return tuple(thing.name for thing in self.objects if thing.role == "object")

    @property
    def receptive(self) -> tuple[str, ...]:
        """Names that a contract may place on or move to: containers and places."""
        containers = (thing.name for thing in self.objects if thing.role == "container")
        return (*containers, *(place.name for place in self.places))


# --- what memory hands to the planner -----------------------------------------------------------------------------


class Exemplar(Record, frozen=True, kw_only=True):
    """One remembered episode with the parts of its retrieval score R = λ_s s + (1 − λ_s) w (paper 5.2).

    `weight` is what all memories of its contract tell near the question. `rank` counts from 1 in its list; `reason` is
    why it did not succeed ("" if it did). `parts` is the cosine of each block of the embedding that both have
    (instruction, summary, symbols, image, state).
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


class MemoryUse(Record, frozen=True):
    """What became of one recalled memory (paper 7.3): whether the planner used it, and whether that contributed."""

    memory: str
    used: bool
    contributing: bool


class Passage(Record, frozen=True, kw_only=True):
    """A quotation that the planner was shown: where it stands, how far its source is trusted, what was shown of it.

    `citation` names document, version and offsets; `likeness` is the cosine of question and passage; `rank` counts
    from 1.
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
    """What the planner is reminded of: `exemplars` to follow, `warnings` (failures, rejections) to avoid, `passages`.

    The first two come from memory, the passages from documents.
    """

    exemplars: tuple[Exemplar, ...] = ()
    warnings: tuple[Exemplar, ...] = ()
    passages: tuple[Passage, ...] = ()


class Proposal(Record, frozen=True, kw_only=True):
    """What a planner answered: raw `text`, why it stopped, who constrained the decoding, and timings [s] by part."""

    text: str
    finish_reason: str
    planner: str
    constrained_by: str
    timings: dict[str, float]


# --- what happened ------------------------------------------------------------------------------------------------


class Attempt(Record, frozen=True):
    """One shot of the planner: what it proposed and what the gate said."""

    proposal: Proposal
    verdict: Verdict
    gate_s: float


class ActionResult(Record, frozen=True, kw_only=True):
    """How one action of the contract ended, by the robot's own senses; `Delta` is Δ over its ticks."""

    skill: str
    status: Literal["done", "failed", "taken_over", "stopped", "not_run"]
    reason: str
    started: float
    ended: float
    Delta: float


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


class Outcome(Record, frozen=True, kw_only=True):
    """The robot's own verdict on an episode (r and Δ of paper 5.1); simulator truth never enters it.

    `Delta` is None when no control was executed (a rejected or declined contract). `taken_over` means that the local
    layer ended the contract; `aborted` that a person did; `stopped` that a fault did. A person's hand has classes of
    its own, from which nothing is learnt: `paused` and `slowed` contracts were finished after a pause or below full
    speed, `handed_over` ones ended because a person took the robot, `emergency` ones in an emergency stop.
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
    hindrance: str = ""
    """What held the robot back at the end of an action that did not succeed: the rows that bound last, in words."""

    @property
    def r(self) -> int:
        """Success label r ∈ {0, 1} (paper 5.1)."""
        return int(self.kind == "succeeded")


class FailureFeedback(Record, frozen=True, kw_only=True):
    """What became of the contract before this one: `done` of its actions, the one `undone`, why, and what hindered it.

    `hindrance` names the pairs that were nearest, or whose rows conflicted, when the action was given up.
    """

    episode_id: str
    outcome: OutcomeClass
    done: tuple[str, ...]
    undone: str
    reason: str
    hindrance: str = ""


class Violation(Record, frozen=True, kw_only=True):
    """One breach seen by the monitor on simulator truth; `peak` is in the unit of its `kind` (N, m, rad, rad/s)."""

    kind: str
    start: float
    duration: float
    peak: float
    bodies: tuple[str, ...]
    perceived: bool = True


class Judgement(Record, frozen=True):
    """What simulator truth says of an episode: task success, progress in [0, 1] and every violation."""

    success: bool
    progress: float
    violations: tuple[Violation, ...] = ()


class Episode(Record, frozen=True, kw_only=True):
    """Everything that one instruction led to; written as `episode.json`."""

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
    """Ticks of the contract on which each barrier bound, by the barrier's name."""
    second_opinion: OutcomeCheck = "none"
    """What another of the robot's own senses says of the outcome, apart from the skills that carried it out."""
    uses: tuple[MemoryUse, ...] = ()
    """What became of each exemplar in the prompt, if the planner was asked again without it."""
    setback: FailureFeedback | None = None
    """What became of the contract before, if this one was planned because that one did not succeed."""
