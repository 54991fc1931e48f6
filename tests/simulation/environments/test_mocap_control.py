"""A Panda whose tool a mocap body drags through a weld: hostile displacements, deviation, gripper, wrong tools."""

import gymnasium
import mujoco
import numpy as np
import pytest

from dualbrain.core.geometry.rotations import matrix_to_quaternion
from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.integration.derating import derate
from dualbrain.simulation.environments import MocapControl, guard_mocap_env
from dualbrain.simulation.models.mujoco_model import load_mujoco_model

PANDA = load_robot("panda")
HOME = np.array(PANDA.home)
SLOW_PANDA = derate(PANDA, period=0.01, max_speed=0.5)
TOOL = SafetyFilter(PANDA).tool(HOME)
ROTATION = matrix_to_quaternion(TOOL.rotation)
JOINTS = tuple(f"arm/joint{k}" for k in range(1, 8))
WALLS = {"left": 1.0, "right": -1.0}
"""Walls on both sides, far away until a test moves them."""
TABLE_TOP = float(TOOL.position[2]) - 0.15


class DraggedPanda(gymnasium.Env):
    """Displacements of 1 cm per unit and 20 ms of the mocap body, above a table."""

    metadata = {"render_modes": []}  # noqa: RUF012  # gymnasium's own form
    dt = 0.02

    def __init__(self):
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float64)
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.model = build_model()
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        for name, value in zip(JOINTS, HOME, strict=True):
            self.data.qpos[self.model.joint(name).qposadr[0]] = value
        self.data.mocap_pos[0], self.data.mocap_quat[0] = TOOL.position, ROTATION
        mujoco.mj_forward(self.model, self.data)
        return np.zeros(1), {}

    def step(self, action):
        self.data.mocap_pos[0] += 0.01 * np.clip(action[:3], -1.0, 1.0)
        mujoco.mj_step(self.model, self.data, nstep=round(self.dt / self.model.opt.timestep))
        mujoco.mj_forward(self.model, self.data)
        return np.zeros(1), 0.0, False, False, {}

    def touches_table(self):
        table = self.model.geom("table").id
        return any(table in (c.geom1, c.geom2) and c.dist < 0.0 for c in self.data.contact)


def build_model():
    root = mujoco.MjSpec()
    root.option.timestep, root.option.gravity = 0.002, [0.0, 0.0, 0.0]
    root.worldbody.add_frame().attach_body(load_mujoco_model("panda").root, "arm/", "")
    probe = root.compile()
    data = mujoco.MjData(probe)
    for name, value in zip(JOINTS, HOME, strict=True):
        data.qpos[probe.joint(name).qposadr[0]] = value
    mujoco.mj_kinematics(probe, data)
    turn = data.body("arm/link7").xmat.reshape(3, 3)
    place = turn.T @ (TOOL.position - data.body("arm/link7").xpos)
    root.body("arm/link7").add_body(name="tool", pos=place, quat=matrix_to_quaternion(turn.T @ TOOL.rotation))
    root.worldbody.add_body(name="mocap", mocap=True)
    weld = root.add_equality(type=mujoco.mjtEq.mjEQ_WELD, name1="mocap", name2="tool")
    weld.objtype, weld.data = mujoco.mjtObj.mjOBJ_BODY, np.array([0.0] * 6 + [1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    root.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.4, 0.4, 0.05], pos=[0.7, 0.0, TABLE_TOP - 0.05]
    )
    for name, side in WALLS.items():
        root.worldbody.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.2, 0.01, 0.2], pos=[TOOL.position[0], 3.0 * side, 0.5]
        )
    for actuator in list(root.actuators):
        root.delete(actuator)
    model = root.compile()
    model.dof_damping[[model.joint(name).dofadr[0] for name in JOINTS]] = 5.0
    return model


def guarded(**options):
    control = MocapControl(
        tool="tool", base="arm/link0", joints=JOINTS, scale=0.01, reference="mocap", rotation=ROTATION
    )
    env = DraggedPanda()
    return env, guard_mocap_env(env, SLOW_PANDA, control, **({"deviation": 0.03} | options))


def push_down(inner, env, steps=150):
    touched, info = False, {}
    env.reset(seed=0)
    for _ in range(steps):
        info = env.step(np.array([0.0, 0.0, -1.0, 0.3]))[4]
        touched |= inner.touches_table()
    return touched, info


def test_displacements_into_the_table_end_above_it():
    inner = DraggedPanda()
    assert push_down(inner, inner)[0]
    inner, env = guarded()
    touched, info = push_down(inner, env)
    assert not touched
    assert info["deviation"] < 0.03
    assert inner.data.body("tool").xpos[2] < TOOL.position[2] - 0.02, "free space is used"


def test_displacements_of_whole_numbers_keep_their_digits():
    places = []
    for action in (np.array([0.0, 0.0, -1.0, 0.0]), [0, 0, -1, 0]):
        inner, env = guarded()
        env.reset(seed=0)
        for _ in range(60):
            env.step(action)
        places.append(inner.data.mocap_pos[0].copy())
    assert np.array_equal(*places)


def stops(env, inner, steps=40):
    """The sentences of all steps downwards in which a bound was exceeded, and the displacement of the tool in each."""
    env.reset(seed=0)
    found = []
    for _ in range(steps):
        before = inner.data.mocap_pos[0].copy()
        info = env.step(np.array([0.0, 0.0, -1.0, 0.3]))[4]
        if "from its computed place" in info["safety"]:
            found.append((info, inner.data.mocap_pos[0] - before))
    return found


def test_a_deviation_beyond_the_bound_brings_the_tool_to_rest_where_it_is_and_is_reported():
    inner, env = guarded(deviation=1e-4)
    found = stops(env, inner)
    assert found
    for info, shift in found:
        assert "A link of the hand" in info["safety"]
        assert "a larger `deviation`" in info["safety"]
        assert info["deviation"] > 1e-4
        assert np.linalg.norm(shift) < 2e-3


def test_each_bound_is_of_its_own_links():
    inner, env = guarded(deviation=0.03, arm_deviation=1e-4)
    found = stops(env, inner)
    assert found
    for info, _ in found:
        assert "A link of the arm" in info["safety"]
        assert "a larger `arm_deviation`" in info["safety"]
        assert info["arm_deviation"] > 1e-4
        assert info["deviation"] < 0.03


def test_obstacles_keep_the_bound_of_the_links_that_they_are_enlarged_for():
    inner, env = guarded(deviation=0.01, arm_deviation=0.04)
    env.reset(seed=0)
    env.step(np.zeros(4))
    hand = {link.name for link in PANDA.links if link.frame == PANDA.n}
    margins = {(one.parts, one.margin) for one in env.safety.tables.obstacles if "table" in one.name}
    assert {(frozenset(parts), margin) for parts, margin in margins} == {
        (frozenset(hand), 0.01),
        (frozenset(link.name for link in PANDA.links) - hand, 0.04),
    }
    assert inner.data.ncon == 0


def test_a_tool_beside_which_no_way_leads_away_holds_its_place():
    """Both walls begin within the bound of the hand: the nearest safe control turns it, which no action does."""
    inner, env = guarded()
    for name, side in WALLS.items():
        inner.model.geom(name).pos[:] = [TOOL.position[0], 0.125 * side, TOOL.position[2]]
    env.reset(seed=0)
    before = inner.data.mocap_pos[0].copy()
    for action in ([0.0, 1.0, 0.0, 0.3], [1.0, -1.0, 0.0, 0.3]) * 8:
        info = env.step(np.array(action))[4]
        assert info["h_min"] < 0.0
        np.testing.assert_allclose(inner.data.mocap_pos[0], before, atol=1e-12)


@pytest.mark.parametrize("rise", [0.11, 0.12])
def test_a_tool_that_is_too_near_leaves_without_a_turn_against_the_action(rise):
    """The table begins within the bound of the hand."""
    inner, env = guarded()
    inner.model.geom("table").pos[2] += rise
    env.reset(seed=0)
    before, h = inner.data.mocap_pos[0].copy(), []
    for step in range(40):
        h.append(env.step(np.array([0.0, 0.0, -1.0, 0.3]))[4]["h_min"])
        np.testing.assert_array_equal(inner.data.mocap_quat[0], ROTATION)
        if step == 0:  # the rows are not known yet, and the nearest safe control turns the tool
            np.testing.assert_allclose(inner.data.mocap_pos[0], before, atol=1e-12)
    assert h[0] < 0.0
    assert h[-1] > -5e-4
    assert inner.data.mocap_pos[0][2] > before[2] + 0.005


@pytest.mark.parametrize("direction", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.6, -0.6)])
def test_a_tool_that_is_driven_at_the_table_slides_along_it_as_fast_as_above_it(direction):
    def travel(down):
        inner, env = guarded()
        env.reset(seed=0)
        for _ in range(70):
            env.step(np.array([0.0, 0.0, down, 0.3]))
        start, touched = inner.data.mocap_pos[0].copy(), False
        for _ in range(20):
            info = env.step(np.array([*direction, down, 0.3]))[4]
            touched |= inner.touches_table()
            assert ("an obstacle limits" in info["safety"]) == (info["status"] == "MODIFIED") == (down < 0.0)
        return np.array(direction) @ (inner.data.mocap_pos[0] - start)[:2], touched

    slid, touched = travel(-1.0)
    free, _ = travel(0.0)
    assert not touched
    assert slid > 0.6 * free > 0.02


def test_the_gripper_passes_unchanged_and_so_does_bad_input_not():
    inner, env = guarded()
    env.reset(seed=0)
    assert env.step(np.array([0.0, 0.0, -1.0, 0.25]))[4]["applied"][3] == 0.25
    before = inner.data.mocap_pos[0].copy()
    info = env.step(np.array([np.nan, 0.0, -1.0, 0.25]))[4]
    assert np.isfinite(info["applied"][:3]).all()
    assert "not finite" in info["safety"]
    assert np.linalg.norm(inner.data.mocap_pos[0] - before) < 5e-3


def test_a_tool_frame_at_another_body_is_refused():
    control = MocapControl(
        tool="arm/link7", base="arm/link0", joints=JOINTS, scale=0.01, reference="mocap", rotation=ROTATION
    )
    with pytest.raises(ConfigurationError, match="robot init --tool"):
        guard_mocap_env(DraggedPanda(), SLOW_PANDA, control)
