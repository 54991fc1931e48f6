"""Offscreen rendering: images show the robot and the scene; without GL the error names the packages to install."""

import os
import subprocess
import sys

import pytest

from dualbrain.errors import UnknownNameError
from dualbrain.simulation.scenes.colours import colour_rgba

RENDER = """
import numpy as np
from dualbrain.simulation.perception.rendering import Camera
from tests.simulation.scripted_hand import make_plant
p = make_plant("tabletop", 3, visuals=True)
with Camera(p, width=320, height=240) as camera:
    for view in ("front", "top", "side"):
        image = camera.capture(view)
        assert image.shape == (240, 320, 3) and image.dtype == np.uint8
        r, g, b = (image[..., k].astype(int) for k in range(3))
        red, blue = (r > 2 * g) & (r > 2 * b), (b > 1.5 * r) & (b > 1.3 * g)
        white = (image.min(axis=2) > 150) & (np.ptp(image, axis=2) < 12)
        assert red.sum() > 10, "the red cube is in view"
        assert blue.sum() > 100, "the blue bowl is in view"
        assert white.sum() > 500, "the white robot is in view"
    try:
        camera.capture("back")
    except Exception as error:
        assert "front" in str(error)
"""

NO_GL = """
import mujoco
from dualbrain.errors import MissingDependencyError
from dualbrain.simulation.perception.rendering import Camera
from tests.simulation.scripted_hand import make_plant
try:
    Camera(make_plant())
except MissingDependencyError as error:
    assert "libosmesa6" in str(error) and "libgl1-mesa-dri" in str(error)
else:
    raise SystemExit("a camera was opened without GL")
"""


def run_program(code, **environment):
    process = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    return process.returncode, process.stderr


def test_the_image_shows_robot_and_scene():
    code, output = run_program(RENDER, MUJOCO_GL="egl")
    if "MissingDependencyError" in output:
        code, output = run_program(RENDER, MUJOCO_GL="osmesa")
    assert code == 0, output


def test_the_error_without_gl_names_the_packages():
    code, output = run_program(NO_GL, MUJOCO_GL="disable")
    assert code == 0, output


def test_unknown_colours_are_rejected():
    with pytest.raises(UnknownNameError, match="red"):
        colour_rgba("rde")
