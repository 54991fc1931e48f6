"""Sample run of 20 s with an intervention in its middle, and runs that were rejected or taken over."""

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
    ("approach", 0, 0.0, 3.6),
    ("descend", 0, 3.6, 5.4),
    ("close", 0, 5.4, 6.2),
    ("lift", 0, 6.2, 8.0),
    ("carry", 1, 8.0, 14.2),
    ("lower", 1, 14.2, 16.0),
    ("open", 1, 16.0, 16.5),
    ("retreat", 1, 16.5, 20.0),
)


@dataclass(frozen=True)
class FakeFilterResult:
    """Result of a filter step."""

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
    """Ticks at 1 kHz: the forearm of a person is close at 10.6 s, and the filter slows the arm to a third."""
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
        state = RobotState(
            stamp=t, sequence=k, q=q, v=u, opening=0.04 if action == 0 and t < 5.6 else 0.024, finger_forces=(0.0, 0.0)
        )
        result = FakeFilterResult(u.astype(np.float32), int(delta > 0), delta, rows, box, h)
        trace.append(t, state, nominal, result, action=action, phase=phase)
    trace.note(0.0, "verdict", "attempt 2 accepted")
    trace.note(9.4, "intervention", "wrist vs 'forearm': slowed 41 %")
    trace.note(20.0, "memory", "in the prompt, rank 1", episode_id="e-0041", before=0.5, after=0.5873)
    trace.note(20.0, "memory", "in the prompt, rank 2", episode_id="e-0017", before=0.62, after=0.6641)
    return trace


def scene() -> Scene:
    """A table with a cube, a bowl, a bottle, a box and a forearm."""
    table = SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)))
    cube = SceneObject(
        name="red_cube", role="object", shape=Box((0.022, 0.022, 0.022)), pose=Pose((0.52, -0.18, 0.022)), colour="red"
    )
    bowl = SceneObject(
        name="bowl", role="container", shape=Bowl(0.085, 0.055, 0.006), pose=Pose((0.45, 0.28, 0.0)), colour="white"
    )
    bottle = SceneObject(
        name="bottle", role="obstacle", shape=Cylinder(0.035, 0.11), pose=Pose((0.62, 0.02, 0.11)), colour="green"
    )
    cereal = SceneObject(
        name="cereal", role="obstacle", shape=Box((0.03, 0.09, 0.14)), pose=Pose((0.70, 0.24, 0.14)), colour="orange"
    )
    perceived = tuple(msgspec.structs.replace(one, error=0.009) for one in (cube, bowl, bottle, cereal))
    across = Pose((0.55, 0.16, 0.30), (0.7071, 0.0, 0.7071, 0.0))
    forearm = SceneObject(
        name="forearm",
        role="person",
        shape=Capsule(0.05, 0.13),
        pose=across,
        velocity=(0.0, -0.12, 0.0),
        error=0.015,
        velocity_error=0.05,
    )
    return Scene(robot="panda", stamp=0.0, version=3, objects=(table, *perceived, forearm))


CONTRACT = Contract(
    "c-0002",
    Context("panda", "3fa9c1d2"),
    (
        Action("grasp", {"object": "red_cube", "force": 12.0, "speed": 0.15, "approach": "top"}),
        Action("place", {"destination": "bowl", "speed": 0.2, "clearance": 0.12, "route": "near_base"}),
    ),
)


def attempts() -> tuple[Attempt, ...]:
    """One contract rejected at the envelope stage, then an accepted contract."""
    first = Proposal(
        text='{"id":"c-0001","action_sequence":[{"skill":"grasp","params":{"speed":3.0}}]}',
        finish_reason="stop",
        planner="qwen2.5-coder-1.5b-instruct",
        constrained_by="llguidance",
        timings={"prompt": 3.11, "decode": 4.25},
    )
    second = Proposal(
        text=msgspec.json.encode(CONTRACT).decode(),
        finish_reason="stop",
        planner="qwen2.5-coder-1.5b-instruct",
        constrained_by="llguidance",
        timings={"prompt": 0.34, "decode": 5.02},
    )
    rejection = Rejected(
        stage="envelope",
        pointer="/action_sequence/0/params/speed",
        got=3.0,
        allowed="0.05 to 0.4 m/s",
        hint="choose a speed of at most 0.4 m/s",
    )
    return Attempt(first, rejection, 52e-6), Attempt(second, Accepted(CONTRACT), 61e-6)


def make_episode(trace: Trace) -> Episode:
    """Episode record of `trace`."""
    summary = trace.summary()
    done = (("grasp", 0.0, 8.0, "both fingers press 12 N"), ("place", 8.0, 19.999, "released over bowl"))
    actions = tuple(
        ActionResult(
            skill=skill, status="done", reason=reason, started=start, ended=end, Delta=trace.summary(k).Delta or 0.0
        )
        for k, (skill, start, end, reason) in enumerate(done)
    )
    outcome = Outcome(
        kind="succeeded",
        reason="red_cube is perceived in bowl",
        Delta=summary.Delta,
        Delta_sum=summary.Delta_sum,
        delta_peak=summary.delta_peak,
        intervention_frequency=summary.intervention_frequency,
        h_min=summary.h_min,
        duration=summary.duration,
        actions=actions,
    )
    recall = RetrievedContext(
        (
            Exemplar(
                episode_id="e-0041",
                instruction="put the red block into the bowl",
                summary="bowl left, forearm",
                contract={},
                succeeded=True,
                Delta=0.0113,
                similarity=0.94,
                weight=0.50,
                score=0.852,
                rank=1,
            ),
            Exemplar(
                episode_id="e-0017",
                instruction="move the cube to the bowl",
                summary="bowl left",
                contract={},
                succeeded=True,
                Delta=0.0042,
                similarity=0.86,
                weight=0.62,
                score=0.812,
                rank=2,
            ),
        ),
        (
            Exemplar(
                episode_id="e-0029",
                instruction="put the cube in the bowl quickly",
                summary="forearm",
                contract={},
                succeeded=False,
                Delta=None,
                similarity=0.88,
                weight=0.21,
                score=0.746,
                rank=1,
            ),
        ),
        (
            Passage(
                citation="site-rules@b857fcc2256e#479-934",
                kind="rule",
                trust="site",
                title="Site rules › Speed",
                text="The usual speed is 0.2 m/s <b>.",
                likeness=0.51,
                score=0.49,
                rank=1,
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
        id="20261121T024611-7f3a",
        started="2026-11-21T02:46:11Z",
        instruction="put the red cube in the bowl",
        robot="panda",
        registry="3fa9c1d2",
        seed=7,
        scene=scene(),
        summary="red_cube right of bottle; person crosses",
        recall=recall,
        attempts=attempts(),
        contract=msgspec.to_builtins(CONTRACT),
        outcome=outcome,
        judgement=Judgement(True, 1.0),
        timings={"planner": 12.72, "recall": 0.021, "execution": 31.4, "report": 0.9},
        versions=versions,
    )


@pytest.fixture(scope="session")
def trace() -> Trace:
    """Trace of the sample run."""
    return synthetic_trace()


@pytest.fixture(scope="session")
def episode(trace: Trace) -> Episode:
    """Episode of the sample run."""
    return make_episode(trace)


@pytest.fixture(scope="session")
def rejected(episode: Episode) -> Episode:
    """Two attempts, both rejected: nothing moved."""
    outcome = Outcome(kind="rejected", reason="no contract passed the gate in 2 attempts")
    return msgspec.structs.replace(
        episode, attempts=episode.attempts[:1] * 2, contract=None, outcome=outcome, judgement=None
    )


@pytest.fixture(scope="session")
def taken_over(episode: Episode) -> Episode:
    """The safety layer ended the contract during its first action."""
    actions = (
        ActionResult(
            skill="grasp", status="taken_over", reason="no progress for 1.5 s", started=0.0, ended=4.0, Delta=0.02
        ),
        ActionResult(skill="place", status="not_run", reason="", started=0.0, ended=0.0, Delta=0.0),
    )
    outcome = Outcome(
        kind="taken_over",
        reason="no progress for 1.5 s",
        Delta=0.02,
        Delta_sum=80.0,
        delta_peak=0.2,
        intervention_frequency=0.11,
        h_min=-0.004,
        duration=4.0,
        actions=actions,
    )
    violation = Violation(kind="collision", start=3.2, duration=0.04, peak=12.7, bodies=("link5", "forearm"))
    return msgspec.structs.replace(episode, outcome=outcome, judgement=Judgement(False, 0.25, (violation,)))
