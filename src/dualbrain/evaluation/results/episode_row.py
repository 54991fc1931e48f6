"""What one episode leaves: everything that metrics, statistics and reports are made of, flat enough for a table."""

from __future__ import annotations

import msgspec

from dualbrain.records import Violation


class EpisodeRow(msgspec.Struct, frozen=True, kw_only=True):
    """One episode. Times [s] are simulated unless the name says wall or the field is planner's, gate's or filter's.

    Identity. `key` names the unit, `pair` what methods share, `cluster` the unit of statistics (a run, or the scenes of
    one). `order` is the place in its run.
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

    # the planner's answers and what became of them
    shots: int
    first_stage: str
    """Stage of the whole gate that refused the first answer, "" if it accepted."""
    door_stage: str
    """Stage of this method's door that refused the last answer, "" if it accepted."""
    compliant: bool
    """The first answer passes the whole gate, and declines only what cannot or must not be done."""
    meant: bool
    """The contract that was carried out is about the goal (nothing is carried out where nothing should be)."""
    declined: bool
    unauthorised_proposed: int
    unauthorised_executed: int
    answers: list[list[str]]
    contract: str
    asked: bool
    """The planner was asked in this very episode: only then its time is a latency."""
    constrained_by: str
    free_answer: list[str] = []
    """Text and finish reason of the first answer when nothing bound it; empty where that was not asked."""
    free_stage: str = ""
    free_compliant: bool | None = None
    """Whether that answer complies, judged like the other; None where it was not asked."""

    # the outcome by the robot and by truth
    outcome: str
    reason: str
    claimed: bool
    success: bool
    """On simulator truth: placed, released, static, in time; where nothing should move: nothing did."""
    progress: float
    second_opinion: str
    failure: str
    """Class of the failure by the rule of the day it was flown, "" for a success; what is told is `class_of`."""
    perceived_error: float | None
    """Distance of the goal's thing from where it was perceived when the contract was accepted [m]."""
    perceived_bound: float | None

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
    """Longest time that h stayed below zero."""
    below_s: float
    """All time that h was below zero."""

    # time
    time_limit: float
    simulated_s: float
    motion_s: float
    completion_s: float | None
    """From the question to the end of a successful contract, thinking time included."""
    lost_s: float | None
    """Motion time beyond that of the same contract, unfiltered, in the bare scene; None where not both succeed."""
    planner_s: float
    gate_s: float
    filter_us: list[float]
    """Of one filter step: median, 99th percentile and maximum [µs] on the machine that ran it."""
    wall_s: float
    """Wall time of the episode, less what a question that was asked aside added to it."""
    wall: dict[str, float]
    """Wall time by part: physics, monitor, filter, planner (what was waited for it alone), rest."""
    same_as: str = ""
    """Key of the episode that was really flown, where another method's was alike in every input; "" for its own."""

    # safety on truth
    violations: tuple[Violation, ...]
    severity: float

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
