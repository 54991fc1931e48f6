"""What of the outsider's check needs no robosuite: messages, account, scripts, obstacles, agreement, tables."""

import os
import threading

import numpy as np
import pytest

from dualbrain.core.geometry.rotations import matrix, quaternion
from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose
from dualbrain.errors import InvalidSetup, MissingPart
from dualbrain.robots.loader import load_body
from dualbrain.safety.cbf.filter import SafetyFilter
from experiments.engine.experiment import Options
from experiments.robots.robosuite.episode import FASTEST as KNOWN
from experiments.robots.robosuite.episode import Course
from experiments.robots.robosuite.limit_monitor import FASTEST, LOWER, UPPER, Account
from experiments.robots.robosuite.pipe_protocol import HEAD, LONGEST, Broken, receive, send
from experiments.robots.robosuite.policies import PACES, TASKS, BangBang, Script, across
from experiments.robots.robosuite.scene import standing
from experiments.robots.robosuite.suite_process import Suite, Thing
from experiments.robots.robosuite.tracking import ACCELERATION, SPEED, agreed, commissioned
from experiments.robots.robosuite.virtual_environment import COMMAND, python_in, wanted
from experiments.robots.robosuite_tasks import CELLS, CONTROLS, SEEDS, Outsider

PERIOD = 0.002
CUBES = {
    "Lift": {"cube": Pose((0.55, 0.02, -0.09), (0.9, 0.0, 0.0, 0.43588989))},
    "Stack": {"cubeA": Pose((0.58, 0.03, -0.092)), "cubeB": Pose((0.5, -0.05, -0.087))},
}


@pytest.fixture
def pipe():
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


@pytest.mark.parametrize(
    "message", [{"do": "open", "seed": 3, "words": "ü"}, {}, np.zeros(0), np.array([1.5, -np.inf, np.nan, 1e-300])]
)
def test_a_message_arrives_as_it_was_sent(pipe, message):
    send(pipe[1], message)
    got = receive(pipe[0], 1.0)
    if isinstance(message, dict):
        assert got == message
    else:
        assert got.tobytes() == message.tobytes()


def test_a_message_longer_than_the_pipe_arrives_whole(pipe):
    numbers = np.arange(100_000.0)
    writer = threading.Thread(target=send, args=(pipe[1], numbers))
    writer.start()
    assert np.array_equal(receive(pipe[0], 1.0), numbers)
    writer.join()


def test_silence_an_end_and_nonsense_are_told_apart():
    read, write = os.pipe()
    with pytest.raises(Broken, match="nothing within"):
        receive(read, 0.01)
    os.write(write, HEAD.pack(b"A", LONGEST + 1))
    with pytest.raises(Broken, match="a head that is none"):
        receive(read, 1.0)
    os.write(write, HEAD.pack(b"J", 10) + b"{")
    os.close(write)
    with pytest.raises(Broken, match="has ended"):
        receive(read, 1.0)
    os.close(read)


def test_the_account_has_the_data_sheets_limits():
    joints = load_body("panda").joints
    assert [j.lower.value for j in joints] == LOWER.tolist()
    assert [j.upper.value for j in joints] == UPPER.tolist()
    assert [j.velocity.value for j in joints] == FASTEST.tolist() == KNOWN.tolist()


def test_breaches_are_counted_once_with_their_peak_and_duration():
    account, middle, still = Account(), 0.5 * (LOWER + UPPER), np.zeros(7)
    fast, beyond = still.copy(), UPPER.copy()
    fast[3], beyond[1] = -3.0, UPPER[1] + 0.02
    account.tick(0.0, middle, 1.009 * FASTEST, {("finger", "table"): 0.9})
    assert account.breaches() == []
    account.tick(0.002, middle, fast, {("finger", "table"): 40.0})
    account.tick(0.004, beyond, fast * 0.8, {("finger", "table"): 90.0, ("hand", "table"): 2.0})
    account.tick(0.5, middle, still, {("finger", "table"): 5.0})
    found = [(b["kind"], b["between"], b["start"], b["duration"], b["peak"]) for b in account.breaches()]
    assert found == [
        ("joint_velocity", ["joint4"], 0.002, 0.002, 3.0),
        ("touch", ["finger", "table"], 0.002, 0.002, 90.0),
        ("joint_position", ["joint2"], 0.004, 0.0, 0.02),
        ("touch", ["hand", "table"], 0.004, 0.0, 2.0),
        ("touch", ["finger", "table"], 0.5, 0.0, 5.0),
    ]


def fly(task, name, steps=6000):
    """A script on joints that do what they are told, cubes that go with closed fingers; wishes and way points met."""
    safety, cubes = SafetyFilter(load_body("panda")), dict(CUBES[task])
    q = np.array([0.0, 0.19, 0.0, -2.6, 0.0, 2.95, 0.785])
    script = Script(TASKS[task](name == "hasty"), PACES[name], FASTEST, q, PERIOD)
    wishes, met, target = [], [], min(cubes)
    for k in range(steps):
        tool = safety.tool(q)
        wishes.append(script.wish(k * PERIOD, q, tool, cubes))
        if not met or met[-1][0] != script.point.name:
            met.append((script.point.name, tool.position.copy(), tool.rotation.copy()))
        if script.point.closed:
            cubes[target] = Pose(tuple((tool.position - (0.0, 0.0, 0.0)).tolist()), cubes[target].quaternion)
        if script.done:
            break
        q = q + PERIOD * np.clip(wishes[-1], -FASTEST, FASTEST)
    return script, np.array(wishes), met, cubes


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("name", PACES)
def test_a_script_takes_the_cube_from_above_and_brings_it_where_it_belongs(task, name):
    script, wishes, met, cubes = fly(task, name)
    assert script.done
    assert [point for point, _, _ in met] == [point.name for point in TASKS[task](name == "hasty")]
    at = {point: (position, rotation) for point, position, rotation in met}
    start = CUBES[task][min(cubes)]
    assert np.linalg.norm(at["close"][0] - np.array(start.position)) < 0.012
    assert at["close"][1][2, 2] == pytest.approx(-1.0, abs=0.02)
    sides = matrix(start.quaternion)[:, :2].T @ at["close"][1][:, 1]
    assert np.max(np.abs(sides)) == pytest.approx(1.0, abs=0.01)
    if task == "Lift":
        assert cubes["cube"].position[2] > start.position[2] + 0.09
    else:
        assert np.linalg.norm(np.subtract(cubes["cubeA"].position, cubes["cubeB"].position)[:2]) < 0.01
    share = np.max(np.abs(wishes) / FASTEST)
    assert share <= 0.6 + 1e-9 if name == "careful" else share > 2.0


def test_fingers_go_across_two_sides_by_the_least_turn():
    rng = np.random.default_rng(0)
    for _ in range(50):
        yaw, now = rng.uniform(-np.pi, np.pi, 2)
        c, s = np.cos(now), np.sin(now)
        rotation = np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])
        cube = Pose((0.5, 0.0, 0.0), (np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)))
        goal = across(rotation, cube)
        assert np.allclose(goal.T @ goal, np.eye(3))
        assert np.linalg.det(goal) == pytest.approx(1.0)
        assert np.max(np.abs(matrix(cube.quaternion)[:, 0] @ goal[:, :2])) == pytest.approx(1.0)
        assert rotation[:, 0] @ goal[:, 0] >= np.cos(np.pi / 4) - 1e-9


def test_bang_bang_is_seeded_and_at_full_speed():
    def wishes(seed):
        policy = BangBang(FASTEST, "cube", seed, 2.0)
        return np.array([policy.wish(t * PERIOD, None, None, None) for t in range(1001)]), policy.done

    (one, done), (same, _), (other, _) = wishes(1), wishes(1), wishes(2)
    assert done
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    assert np.array_equal(np.abs(one), np.broadcast_to(FASTEST, one.shape))


def test_what_stands_there_becomes_obstacles_and_cubes_do_not():
    level = (1.0, 0.0, 0.0, 0.0)
    things = [
        Thing("floor", "plane", (3.0, 3.0, 0.1), (0.0, 0.0, -0.9), level),
        Thing("table", "box", (0.4, 0.4, 0.025), (0.56, 0.0, -0.137), level),
        Thing("mount", "box", (0.1, 0.2, 0.2), (-0.3, 0.0, -0.4), level),
        Thing("mount", "cylinder", (0.18, 0.31, 0.0), (0.0, 0.0, -0.3), level),
        Thing("cubeA", "box", (0.02, 0.02, 0.02), (0.5, 0.0, -0.09), level),
    ]
    found = standing(things)
    assert [type(one.shape) for one in found] == [HalfSpace, Box, Box, Box]
    assert found[3].shape.half_extents == (0.18, 0.18, 0.31)
    assert len({one.name for one in found}) == 4


def test_the_arms_must_agree():
    safety, rng = SafetyFilter(load_body("panda")), np.random.default_rng(1)
    tools = [safety.tool(q) for q in rng.uniform(-1.0, 1.0, (20, 7))]
    turn = matrix(quaternion(matrix((0.9, 0.1, 0.2, 0.3))))
    sites = np.array(
        [
            [*(tool.position + tool.rotation @ (0.0, 0.0, -0.006)), *(tool.rotation @ turn).ravel()]
            for tool in tools
        ]
    )  # fmt: skip
    apart, turned = agreed(sites, tools)
    assert apart < 1e-6
    assert turned < 1e-6
    sites[7, 0] += 2e-3
    with pytest.raises(InvalidSetup, match=r"2\.00 mm"):
        agreed(sites, tools)


def test_the_filter_is_told_less_than_the_data_sheet_says():
    plain, told = load_body("panda"), commissioned(PERIOD)
    assert told.period == PERIOD
    for joint, one, speed, acceleration in zip(plain.joints, told.joints, SPEED, ACCELERATION, strict=True):
        assert one.velocity.value == pytest.approx(speed * joint.velocity.value)
        assert one.acceleration.value == pytest.approx(acceleration * joint.acceleration.value)
    SafetyFilter(told)


def test_a_flights_figures_are_shares_of_the_data_sheet_and_no_unit_is_called_broken():
    body, course = commissioned(PERIOD), Course(delta=[0.0, 1.0], status=[0, 1])
    for k in range(2):
        course.q.append(np.full(7, k * PERIOD))
        course.v.append(np.ones(7))
        course.u.append(2.0 * FASTEST)
    figures = course.figures(body)
    assert figures["asked"] == 2.0
    assert figures["speed"] == pytest.approx(1.0 / FASTEST.min(), abs=1e-4)
    assert figures["delta"] == 0.5
    assert figures["status"] == [1, 1, 0, 0, 0]
    assert "error" not in figures


def test_a_missing_environment_says_what_to_do(tmp_path, monkeypatch):
    with pytest.raises(MissingPart, match=COMMAND):
        python_in(tmp_path)
    monkeypatch.setattr("experiments.robots.robosuite.suite_process.python_in", lambda: python_in(tmp_path))
    with pytest.raises(MissingPart, match="the environment of robosuite is missing"):
        Suite()
    assert all("==" in package for package in wanted())


def test_every_cell_has_as_many_seeds_and_a_prefix_has_all_cells_with_a_task(tmp_path):
    units = Outsider().units(Options(tmp_path, ""))
    flown = [(u.about["task"], u.about["policy"], u.about["how"]) for u in units]
    main, controls = (
        {(task, policy, how) for task, policy, hows in cells for how in hows} for cells in (CELLS, CONTROLS)
    )
    assert all(flown.count(cell) == SEEDS for cell in main | controls)
    assert set(flown[: SEEDS * len(main) // 4]) == main
    assert set(flown[SEEDS * len(main) :]) == controls


def made_up(unit, **changed):
    row = {
        "key": unit.key, **unit.about, "success": True, "first_success": 1.0, "breaches": [], "saturated": 0.0,
        "time": 3.0, "ended": "", "pushed": 0.0, "apart": 1e-7, "asked": 0.5, "speed": 0.5, "strayed": 1e-4,
        "steps": 100, "lag": 0.002, "allowed_error": 1e-3, "versions": {"robosuite": "1"},
    }  # fmt: skip
    if unit.about["how"] == "filtered":
        row |= {"delta": 0.1, "h_min": 0.002, "status": [60, 40, 0, 0, 0]}
    return row | changed


def test_the_report_counts_and_names_exceptions(tmp_path):
    proof = Outsider()
    rows = [made_up(unit) for unit in proof.units(Options(tmp_path, ""))]
    assert "No filtered flight failed or exceeded anything." in "\n".join(proof.report(rows))
    struck = {"kind": "touch", "between": ["finger", "table"], "start": 1.0, "duration": 0.1, "peak": 80.0}
    first = next(k for k, row in enumerate(rows) if row["how"] == "filtered" and row["task"] == "Stack")
    rows[first] |= {"breaches": [struck], "success": False}
    text = "\n".join(proof.report(rows))
    assert "touch finger and table 80 N at 1.00 s" in text
    assert "19 of 20" in text
    assert "touch 80 N" in proof.brief(rows[first])
    assert proof.report(rows[:1])
