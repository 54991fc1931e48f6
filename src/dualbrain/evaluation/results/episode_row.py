"""Result rows: one flat record per episode, from which all metrics, statistics and reports are computed."""

from __future__ import annotations

import msgspec

from dualbrain.records import Violation


class EpisodeRow(msgspec.Struct, frozen=True, kw_only=True):
    """One episode. Times [s] are simulated, except `wall*`, `planner_s`, `gate_s` and `filter_us`, which are wall time.

    `key` identifies the episode; paired episodes of different methods share `pair`; `cluster` is the unit of statistics
    (a run, or the scenes of one sentence); `order` is the position in the run.
    """

    key: str
    pair: str
    cluster: str
    suite: str
    method: str
    robot: str
    task: str
    family: str
    level: str
    seed: int
    repetition: int
    order: int
    wording: int
    held_out: bool
    instruction: str
    label: str
    planner: str

    # the planner's answers and the gate's verdicts
    shots: int
    first_stage: str
    """Stage of the full gate that rejected the first answer, "" if it was accepted."""
    door_stage: str
    """Stage of this method's gate that rejected the last answer, "" if it was accepted."""
    compliant: bool
    """The first answer passes the full gate, and declines if and only if the request is to be declined."""
    meant: bool
    """The executed contract serves the goal (or nothing was executed where nothing should be)."""
    declined: bool
    unauthorised_proposed: int
    unauthorised_executed: int
    answers: list[list[str]]
    contract: str
    asked: bool
    """An answer was computed in this episode (not cached) or taken from memory: only then `planner_s` is a latency."""
    constrained_by: str
    free_answer: list[str] = []
    """Text and finish reason of the first answer under unconstrained decoding; empty if it was not requested."""
    free_stage: str = ""
    free_compliant: bool | None = None
    """Whether the unconstrained answer complies, judged as `compliant`; None if it was not requested."""

    # the outcome according to the robot and to ground truth
    outcome: str
    reason: str
    failure_cause: str = ""
    """Cause for which a skill failed (`FailureCause`), "" if none did, and in older results."""
    claimed: bool
    success: bool
    """On ground truth: placed, released, at rest, in time; if nothing may move: nothing did."""
    progress: float
    second_opinion: str
    sense_placed: str = ""
    """Verdict of each sense of the robot on the outcome: confirmed, contradicted, or not judged ("": older results)."""
    sense_intact: str = ""
    sense_held: str = ""
    sense_undisturbed: str = ""
    sense_fulfilled: str = ""
    judged: bool = True
    """The words of the instruction could be judged. False only for a decline of words that the judge cannot read, and
    without a judgement; `success`, which is judged by the goal of the case, counts in any case."""
    failure: str
    """Failure class by the rule at the time of the run, "" for a success; reports use `failure_class_of` instead."""
    perceived_error: float | None
    """Distance of the goal's object from its perceived position when the contract was accepted [m]."""
    perceived_bound: float | None
    """Declared upper bound of that distance [m]."""

    # intervention
    guarded: bool
    Delta: float | None
    delta_rows: float | None
    delta_box: float | None
    delta_supervisor: float | None
    delta_peak: float
    frequency: float | None
    h_min: float | None
    recovery_s: float
    """Longest uninterrupted time with h < 0."""
    below_s: float
    """Total time with h < 0."""
    margin_causes: list[str] = []
    """Cause of each interval with h < 0 (`MarginShortfall.label`)."""

    # time
    time_limit: float
    simulated_s: float
    motion_s: float
    completion_s: float | None
    """From the planner request to the end of a successful contract, including planning time."""
    lost_s: float | None
    """Additional motion time compared with the same contract without filter and obstacles; None unless both succeed."""
    planner_s: float
    gate_s: float
    filter_us: list[float]
    """Duration of one filter step: median, 99th percentile and maximum [µs] on the machine of the run."""
    wall_s: float
    """Wall time of the episode, without the time of additional unconstrained requests."""
    wall: dict[str, float]
    """Wall time by part: physics, monitor, filter, planner (only waiting for it), rest."""
    same_as: str = ""
    """Key of the episode of another method that had the same inputs and whose result this is; "" for an own episode."""

    # safety on ground truth
    violations: tuple[Violation, ...]
    severity: float
    over_speed_share: float | None = None
    """Share of the checks in which the tool was above its speed limit; None in rows without this measurement."""
    fragile_force: float | None = None
    """Largest normal force on a fragile object [N]; None without a fragile object or without this measurement."""
    physics_warnings: int = 0
    """How often the physics engine reported a state that is not finite or too large."""

    # memory
    recalled: int
    uses_asked: int
    used: int
    contributing: int
    memories: int
    ledger: str
    epsilon: float | None

    # curves
    trace_t: list[float]
    trace_h: list[float]
    trace_delta: list[float]
