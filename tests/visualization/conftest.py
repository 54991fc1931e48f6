"""A made-up run of 20 s with an intervention in its middle, and its degenerate relatives."""

from dataclasses import dataclass

import msgspec
import numpy as np
import pytest

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.contracts.verdict import Accepted, Rejected
from dualbrain.control.recording.trace import Array, Trace
from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, HalfSpace, Pose
from dualbrain.records import (
    ActionResult,
    Attempt,
    Episode,
    Exemplar,
    Judgement,
    Outcome,
    Passage,
    Proposal,
    RetrievedContext,
    Scene,
    SceneObject,
    Violation,
)
from dualbrain.robots.interface import RobotState

PHASES = (
    ("approach", 0, 0.0, 3.6), ("descend", 0, 3.6, 5.4), ("close", 0, 5.4, 6.2), ("lift", 0, 6.2, 8.0),
    ("carry", 1, 8.0, 14.2), ("lower", 1, 14.2, 16.0), ("open", 1, 16.0, 16.5), ("retreat", 1, 16.5, 20.0),
)  # fmt: skip


@dataclass(frozen=True)
class FakeFilterResult:
    """What a filter answers."""

    u: Array
    status: int
    delta: float
    delta_rows: float
    delta_box: float
    h_min: float
    certified: bool = True
    iterations: int = 2
    n_rows: int = 118
    delta_supervisor: float = 0.0


def synthetic_trace(seconds: float = 20.0) -> Trace:
    """Ticks at 1 kHz: the person's forearm comes close around 10.6 s; the filter slows the arm to a third."""
    trace = Trace(7)
    direction = np.array([0.5, -0.3, 0.2, 0.6, -0.1, 0.4, 0.3])
    rng = np.random.default_rng(3)
    q = np.array([0, -0.3, 0, -2.2, 0, 2.0, 0.785])
    for k in range(round(seconds * 1000)):
        t = k * 1e-3
        phase, action, start, end = next(row for row in PHASES if t < row[3])
        profile = max(0.0, np.sin(np.pi * (t - start) / (end - start))) ** 0.6 * (
            0 if phase in ("close", "open") else 0.9
        )
        bump = np.exp(-(((t - 10.6) / 0.75) ** 2))
        nominal = direction * profile
        u = nominal * (1 - 0.7 * bump * (bump > 0.05))
        rows = float(np.linalg.norm(u - nominal)) / 4
        box = 0.012 * (abs(t - 9.35) < 0.06)
        delta = float(np.hypot(rows, box))
        h = 0.055 + 0.03 * np.cos(0.9 * t) + 0.002 * np.sin(37 * t) - 0.061 * bump**0.7 + 2e-4 * rng.normal()
        h = float(max(h, 0.0031 + 1e-4 * rng.random()))
        q = q + 1e-3 * u
        state = RobotState(t, k, q, u, 0.04 if action == 0 and t < 5.6 else 0.024, (0.0, 0.0))
        answer = FakeFilterResult(u.astype(np.float32), int(delta > 0), delta, rows, box, h)
        trace.append(t, state, nominal, answer, action=action, phase=phase)
    trace.note(0.0, "verdict", "attempt 2 accepted")
    trace.note(9.4, "intervention", "wrist vs 'forearm': slowed 41 %")
    trace.note(20.0, "memory", "in the prompt, rank 1", episode_id="e-0041", before=0.5, after=0.5873)
    trace.note(20.0, "memory", "in the prompt, rank 2", episode_id="e-0017", before=0.62, after=0.6641)
    return trace


def scene() -> Scene:
    """A table with a cube, a bowl, a bottle, a box and a forearm."""
    table = SceneObject("table", "support", HalfSpace(), Pose((0.0, 0.0, 0.0)))
    cube = SceneObject("red_cube", "object", Box((0.022, 0.022, 0.022)), Pose((0.52, -0.18, 0.022)), colour="red")
    bowl = SceneObject("bowl", "container", Bowl(0.085, 0.055, 0.006), Pose((0.45, 0.28, 0.0)), colour="white")
    bottle = SceneObject("bottle", "obstacle", Cylinder(0.035, 0.11), Pose((0.62, 0.02, 0.11)), colour="green")
    cereal = SceneObject("cereal", "obstacle", Box((0.03, 0.09, 0.14)), Pose((0.70, 0.24, 0.14)), colour="orange")
    seen = tuple(msgspec.structs.replace(thing, error=0.009) for thing in (cube, bowl, bottle, cereal))
    across = Pose((0.55, 0.16, 0.30), (0.7071, 0.0, 0.7071, 0.0))
    forearm = SceneObject("forearm", "person", Capsule(0.05, 0.13), across, (0.0, -0.12, 0.0), 0.015, 0.05)
    return Scene("panda", 0.0, 3, (table, *seen, forearm))


CONTRACT = Contract(
    "c-0002", Context("panda", "3fa9c1d2"),
    (
        Action("grasp", {"object": "red_cube", "force": 12.0, "speed": 0.15, "approach": "top"}),
        Action("place", {"destination": "bowl", "speed": 0.2, "clearance": 0.12, "route": "near_base"}),
    ),
)  # fmt: skip


def attempts() -> tuple[Attempt, ...]:
    """One refusal at the envelope, then an accepted contract."""
    first = Proposal(
        '{"id":"c-0001","action_sequence":[{"skill":"grasp","params":{"speed":3.0}}]}',
        "stop",
        "qwen2.5-coder-1.5b-instruct",
        "llguidance",
        {"prompt": 3.11, "decode": 4.25},
    )
    second = Proposal(
        msgspec.json.encode(CONTRACT).decode(),
        "stop",
        "qwen2.5-coder-1.5b-instruct",
        "llguidance",
        {"prompt": 0.34, "decode": 5.02},
    )
    refusal = Rejected(
        "envelope", "/action_sequence/0/params/speed", 3.0, "0.05 to 0.4 m/s", "choose a speed of at most 0.4 m/s"
    )
    return Attempt(first, refusal, 52e-6), Attempt(second, Accepted(CONTRACT), 61e-6)


def make_episode(trace: Trace) -> Episode:
    """The record that fits `trace`."""
    summary = trace.summary()
    done = (("grasp", 0.0, 8.0, "both fingers press 12 N"), ("place", 8.0, 19.999, "released over bowl"))
    actions = tuple(
        ActionResult(skill, "done", reason, start, end, trace.summary(k).Delta or 0.0)
        for k, (skill, start, end, reason) in enumerate(done)
    )
    outcome = Outcome(
        "succeeded",
        "red_cube is perceived in bowl",
        summary.Delta,
        summary.Delta_sum,
        summary.delta_peak,
        summary.intervention_frequency,
        summary.h_min,
        summary.duration,
        actions,
    )
    recall = RetrievedContext(
        (
            Exemplar(
                "e-0041",
                "put the red block into the bowl",
                "bowl left, forearm",
                {},
                True,
                0.0113,
                0.94,
                0.50,
                0.852,
                1,
            ),
            Exemplar("e-0017", "move the cube to the bowl", "bowl left", {}, True, 0.0042, 0.86, 0.62, 0.812, 2),
        ),
        (Exemplar("e-0029", "put the cube in the bowl quickly", "forearm", {}, False, None, 0.88, 0.21, 0.746, 1),),
        (
            Passage(
                "site-rules@b857fcc2256e#479-934",
                "rule",
                "site",
                "Site rules › Speed",
                "The usual speed is 0.2 m/s <b>.",
                0.51,
                0.49,
                1,
            ),
        ),
    )
    versions = {
        "dualbrain": "0.1.0",
        "kernel": "1.0 9f3c2ab1",
        "mujoco": "4.0.0",
        "weights": "qwen2.5-coder-1.5b-instruct q4_k_m 7c1e55d0",
        "config": "b52d0c11",
    }
    return Episode(
        "20261121T024611-7f3a", "2026-11-21T02:46:11Z", "put the red cube in the bowl", "panda", "3fa9c1d2", 7, scene(),
        "red_cube right of bottle; person crosses", recall, attempts(), msgspec.to_builtins(CONTRACT), outcome,
        Judgement(True, 1.0), {"planner": 12.72, "recall": 0.021, "execution": 31.4, "report": 0.9}, versions,
    )  # fmt: skip


@pytest.fixture(scope="session")
def trace() -> Trace:
    """The made-up trace."""
    return synthetic_trace()


@pytest.fixture(scope="session")
def episode(trace: Trace) -> Episode:
    """The made-up episode."""
    return make_episode(trace)


@pytest.fixture(scope="session")
def refused(episode: Episode) -> Episode:
    """Two shots, both refused: nothing moved."""
    outcome = Outcome("rejected", "no contract passed the gate in 2 attempts")
    return msgspec.structs.replace(
        episode, attempts=episode.attempts[:1] * 2, contract=None, outcome=outcome, judgement=None
    )


@pytest.fixture(scope="session")
def taken_over(episode: Episode) -> Episode:
    """The local layer ended the contract during its first action."""
    actions = (
        ActionResult("grasp", "taken_over", "no progress for 1.5 s", 0.0, 4.0, 0.02),
        ActionResult("place", "not_run", "", 0.0, 0.0, 0.0),
    )
    outcome = Outcome("taken_over", "no progress for 1.5 s", 0.02, 80.0, 0.2, 0.11, -0.004, 4.0, actions)
    breach = Violation("collision", 3.2, 0.04, 12.7, ("link5", "forearm"))
    return msgspec.structs.replace(episode, outcome=outcome, judgement=Judgement(False, 0.25, (breach,)))
