"""The C++ controller against stub headers: the controls of the Python filter, bit for bit, and its handling of faults.

The stubs were written for this test; nothing here shows that the controller runs in a controller manager of ROS.
"""

import shutil
import subprocess
from xml.etree import ElementTree

import numpy as np
import pytest

from dualbrain import HalfSpace, Obstacle, SafetyFilter, load_robot
from dualbrain.core.geometry.shapes import Box, Capsule, Pose, Sphere
from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.filter import Contact
from dualbrain.safety.cbf.obstacles import NearSpeed
from dualbrain.safety.integration.derating import derate
from dualbrain.safety.integration.kernel_tables import HEADER, format_kernel_tables
from tests.kernel.compilers import GCC, ROOT, WARNINGS, compiler_flags, kernel_sources

pytestmark = pytest.mark.skipif(
    shutil.which("gcc") is None or shutil.which("g++") is None, reason="no compiler for C and C++ is installed"
)
PACKAGE = ROOT / "integrations/ros2_control"
STUBS = ROOT / "tests/integrations/ros2_control/stubs"
CPP_WARNINGS = [flag for flag in WARNINGS if flag != "-Wstrict-prototypes"]
OBSTACLES = (
    Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.2)), parts=("hand", "fingers")),
    Obstacle("crate", Box((0.1, 0.1, 0.3)), Pose((0.45, 0.3, 0.3)), margin=0.01),
    Obstacle("post", Capsule(0.04, 0.3), Pose((0.4, -0.3, 0.4)), near=NearSpeed(speed=0.1, distance=0.1)),
)
STEPS, HOLD = 1500, 150
"""Steps of a recorded case, and steps with the same reference."""


def make_filter(name="panda", obstacles=OBSTACLES):
    robot_model = derate(load_robot(name), period=0.002)
    return SafetyFilter(robot_model, operating_config(robot_model), obstacles=obstacles)


@pytest.fixture(scope="module")
def harness(tmp_path_factory):
    """The controller, the kernel and the stubs as one program."""
    folder = tmp_path_factory.mktemp("controller")
    GCC.run("-O1", f"-I{ROOT / 'kernel/include'}", f"-I{ROOT / 'kernel/src'}", "-c", *kernel_sources(), cwd=folder)
    sources = [*sorted(PACKAGE.glob("src/*.cpp")), ROOT / "tests/integrations/ros2_control/harness.cpp"]
    includes = [f"-I{path}" for path in (PACKAGE / "include", STUBS, ROOT / "kernel/include")]
    command = ["g++", "-std=c++17", "-O1", *CPP_WARNINGS, *includes, *map(str, sources)]
    command += [*map(str, sorted(folder.glob("*.o"))), "-o", str(folder / "harness")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder / "harness"


def run(harness, tmp_path, tables, lines, rate=500, joints=()):
    """Names of the interfaces, and an array of results and commands per step and at the end."""
    path = tmp_path / "robot.tables"
    path.write_text(tables)
    command = [str(harness), str(path), str(rate), *joints]
    done = subprocess.run(command, input="\n".join(lines) + "\n", capture_output=True, text=True, check=False)
    if done.returncode != 0:
        return done.returncode, done.stderr
    names, *rows = done.stdout.splitlines()
    return names.split(), np.array([[float.fromhex(word) for word in row.split()] for row in rows])


def numbers(*arrays):
    return " ".join(repr(float(value)) for value in np.concatenate(arrays))


def recorded_cases(safety, seed):
    """Lines of a closed loop at random references, and the controls of the Python filter."""
    rng = np.random.default_rng(seed)
    n = safety.robot_model.n
    v_max = np.array([joint.velocity.value for joint in safety.robot_model.joints])
    q, v = np.array(safety.robot_model.home), 0.1 * rng.uniform(-v_max, v_max)
    lines, controls, met = [f"activate {numbers(q, v)}"], [], set()
    safety.reset(np.float32(v))
    for step in range(STEPS):
        if step % HOLD == 0:
            reference = rng.uniform(-0.5, 0.5, n) * v_max
        lines.append(f"step {numbers(q, v, reference)}")
        result = safety(q, v, reference)
        controls.append(result.u)
        met |= {name for name in ("table", "crate", "post") if name in result.explain()}
        v = v + 0.3 * (controls[-1] - v)
        q = q + safety.robot_model.period * v
    return lines, np.array(controls), met


@pytest.mark.parametrize(("name", "seed"), [("panda", 0), ("panda", 1), ("ur5e", 1), ("fr3", 1)])
def test_the_controls_are_those_of_the_python_filter_bit_for_bit(harness, tmp_path, name, seed):
    safety = make_filter(name)
    lines, controls, met = recorded_cases(safety, seed)
    assert "crate" in met
    names, rows = run(harness, tmp_path, format_kernel_tables(safety), lines)
    joints = [joint.name for joint in safety.robot_model.joints]
    assert names == [
        *(f"{joint}/velocity" for joint in joints),
        *(f"{joint}/position" for joint in joints),
        *(f"{joint}/velocity" for joint in joints),
        *(f"safety_filter/{joint}/velocity" for joint in joints),
    ]
    assert np.all(rows[:, 0] == 1.0)
    assert np.array_equal(rows[:-1, 1:], controls)
    assert np.all(rows[-1, 1:] == 0.0)  # deactivated


def moving_lines(safety):
    """Lines that accelerate the arm, and its state then."""
    q, v = np.array(safety.robot_model.home), np.zeros(7)
    reference = np.array([0.0] * 6 + [0.3])
    lines = [f"activate {numbers(q, v)}"]
    for _ in range(100):
        lines.append(f"step {numbers(q, v, reference)}")
        v = reference
    return lines, q, v, reference


@pytest.mark.parametrize("fault", ["reference", "position", "velocity", "lost", "unchained"])
def test_the_arm_comes_to_rest_at_an_unusable_input(harness, tmp_path, fault):
    safety = make_filter()
    lines, q, v, reference = moving_lines(safety)
    bad = {"q": q.copy(), "v": v.copy(), "reference": reference.copy()}
    if fault in ("position", "velocity", "reference"):
        bad[{"position": "q", "velocity": "v"}.get(fault, fault)][3] = np.nan
    lines += ["chain 0"] if fault == "unchained" else []
    for _ in range(100):
        lines += ["lose"] if fault == "lost" else []
        lines.append(f"step {numbers(bad['q'], bad['v'], bad['reference'])}")
    _, rows = run(harness, tmp_path, format_kernel_tables(safety), lines)
    moving, stopping = rows[:100, 1:], rows[100:200, 1:]
    assert moving[-1] == pytest.approx(reference, abs=1e-5)
    assert np.all(stopping[-1] == 0.0)
    acceleration = np.array([joint.acceleration.value for joint in safety.robot_model.joints])
    changes = np.abs(np.diff(rows[:200, 1:], axis=0))
    assert np.all(changes <= 1.0001 * acceleration * 0.002)


def test_interfaces_that_refuse_a_command_are_an_error(harness, tmp_path):
    safety = make_filter()
    lines, q, v, reference = moving_lines(safety)
    lines += ["lock 1", f"step {numbers(q, v, reference)}", "lock 0"]
    _, rows = run(harness, tmp_path, format_kernel_tables(safety), lines)
    assert rows[:, 0].tolist() == [1.0] * 100 + [0.0, 1.0]


def test_joints_may_have_other_names_in_ros(harness, tmp_path):
    names = [f"left_{index}" for index in range(7)]
    found, _ = run(harness, tmp_path, format_kernel_tables(make_filter()), [], joints=names)
    assert found[:7] == [f"{name}/velocity" for name in names]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: "", "begin"),
        (lambda text: text.replace("tables 1", "tables 9"), HEADER),
        (lambda text: text.replace("\nspheres ", "\nsphere "), "lack `spheres`"),
        (lambda text: text.replace("\nperiod 1 0.002", "\nperiod 1 fast"), "no number"),
        (lambda text: text.replace("\nperiod 1 0.002", "\nperiod 1"), "stated number"),
        (lambda text: text.replace("\nq_lower 7 ", "\nq_lower 8 0.0 "), "expected number"),
        (lambda text: text[: len(text) // 2], "`"),
        (lambda text: text + "joint_margin 1 0.1\n", "unknown key `joint_margin`"),
        (lambda text: text.replace("\nnear 5 2.0", "\nnear 5 9.0"), "unknown obstacle"),
    ],
)
def test_wrong_tables_are_refused(harness, tmp_path, change, words):
    code, error = run(harness, tmp_path, change(format_kernel_tables(make_filter())), [])
    assert code == 3
    assert words in error or "no kernel tables" in error
    assert "dualbrain ros2 tables" in error


def test_another_update_rate_or_number_of_joints_is_refused(harness, tmp_path):
    tables = format_kernel_tables(make_filter())
    code, error = run(harness, tmp_path, tables, [], rate=1000)
    assert (code, "--period 0.001" in error) == (3, True)
    code, error = run(harness, tmp_path, tables, [], joints=["a", "b"])
    assert (code, "2 names" in error) == (3, True)


def test_tables_express_only_fixed_obstacles_of_an_arm():
    moving = Obstacle("person", Sphere(0.1), Pose((0.3, 0.0, 1.1)), static=False)
    with pytest.raises(ConfigurationError, match="person moves"):
        format_kernel_tables(make_filter(obstacles=(moving,)))
    safety = make_filter()
    safety.permit([Contact("hand", "crate", 0.1)])
    with pytest.raises(ConfigurationError, match="permitted contacts"):
        format_kernel_tables(safety)
    with pytest.raises(ConfigurationError, match="mobile base"):
        format_kernel_tables(SafetyFilter(load_robot("mobile_panda")))


def test_the_package_files_name_the_controller():
    plugin = ElementTree.parse(PACKAGE / "dualbrain_controllers.xml").getroot()
    package = ElementTree.parse(PACKAGE / "package.xml").getroot()
    kind = plugin.find("class").get("type")
    assert f"PLUGINLIB_EXPORT_CLASS({kind}," in (PACKAGE / "src/safety_filter_controller.cpp").read_text("utf-8")
    assert plugin.get("path") == package.findtext("name")
    cmake = (PACKAGE / "CMakeLists.txt").read_text("utf-8")
    assert f"project({package.findtext('name')} " in cmake
    assert plugin.find("class").get("name") in (PACKAGE / "config/example.yaml").read_text("utf-8")
    for dependency in package.iterfind("depend"):
        assert f"find_package({dependency.text} REQUIRED)" in cmake
    flags = [flag for flag in compiler_flags() if flag.startswith("-f")]
    assert all(flag in cmake for flag in flags)
