"""The profile for little memory: its size, the bits of the host, and its limits."""

import shutil
import subprocess

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Contact, Obstacle
from dualbrain.safety.target.boards import find_board
from dualbrain.safety.target.build import Firmware, build_firmware
from dualbrain.safety.target.firmware_size import firmware_size
from dualbrain.safety.target.target_filter import EmulatedTarget

PANDA = load_robot("panda")
CONFIG = operating_config(PANDA)
HOME = np.array(PANDA.home)
RAM, STACK = 48_000, 18_000
"""Most memory of the small profile, and of the stack [bytes]."""


def build(folder, profile):
    firmware = Firmware(board=find_board("an386"), key=bytes(16), link="uart", lockstep=False, profile=profile)
    return build_firmware(firmware, PANDA, CONFIG, folder)


def test_the_small_profile_fits_48_kilobytes(tmp_path):
    small, full = (firmware_size(build(tmp_path / profile, profile)) for profile in ("small", "full"))
    assert small.ram <= RAM < full.ram
    if shutil.which("arm-none-eabi-size"):
        command = ["arm-none-eabi-size", str(tmp_path / "small/firmware.elf")]
        text, data, bss = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[6:9]
        assert (small.flash, small.ram) == (pytest.approx(int(text) + int(data), abs=64), int(data) + int(bss))


@pytest.fixture(scope="module")
def small():
    with EmulatedTarget("an386", PANDA, CONFIG, profile="small") as target:
        yield target


def balls(count):
    turn = 2 * np.pi / 12
    return [
        Obstacle(f"o{k}", Sphere(0.05), Pose((0.55 * np.cos(turn * k), 0.55 * np.sin(turn * k), 0.4)), margin=0.005)
        for k in range(count)
    ]


def test_the_small_profile_has_the_bits_of_a_host_that_does_not_know_the_opening(small):
    rng = np.random.default_rng(8)
    safety, host = small.filter(), SafetyFilter(PANDA, CONFIG)
    q, u, u_nom, limited = HOME.copy(), np.zeros(7), np.zeros(7), 0
    for filters in (safety, host):
        filters.attach([[0.0, 0.0, 0.05, 0.03]], 0.004)
    for i in range(600):
        now = 1e-3 * i
        if i % 100 == 0:
            u_nom = rng.choice([-1.0, 1.0], 7) * [joint.velocity.value for joint in PANDA.joints]
            for one in (safety, host):
                one.observe(balls(12), now)
                one.permit([Contact("hand", "o3", 0.05)])
        result = safety(q, u, u_nom, now, 0.01)
        expected = host(q, u, u_nom, now, None)
        assert result.u.tobytes() == expected.u.tobytes()
        u, q = result.u, q + 1e-3 * result.u
        limited += result.h_min < 0.05
    assert (safety.target.lost, safety.target.steps, safety.target.differences) == ("", 600, 0)
    assert limited > 20


def test_more_obstacles_than_the_profile_has_room_for_are_refused_by_number(small):
    safety = small.filter()
    safety.observe(balls(12), 0.0)
    with pytest.raises(ConfigurationError, match="at most 12 on this target"):
        safety.target.set_obstacles(np.zeros((13, 29)))


def test_the_stack_of_a_run_is_below_its_documented_size(small):
    """Bytes below the top of the stack that were written; the memory is zero before the start."""
    memory = small.board.link._memory
    top = (16 << 20) - (64 << 10)
    used = np.frombuffer(memory[top - 65536 : top], np.uint8)
    depth = len(used) - int(np.argmax(used != 0))
    assert 1000 < depth <= STACK


def test_an_unknown_profile_and_a_file_that_is_no_firmware_are_named(tmp_path):
    with pytest.raises(UnknownNameError, match="small"):
        build(tmp_path, "smal")
    (tmp_path / "firmware.elf").write_bytes(b"\x7fELF")
    with pytest.raises(ConfigurationError, match="32 bit"):
        firmware_size(tmp_path / "firmware.elf")
