"""`--image` of `plan` and `run`: the camera image reaches the planner and the run folder, or a sentence refuses it."""

import json
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from dualbrain.adaptation.serving import open_planner
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.errors import ConfigurationError
from dualbrain.planner.camera_image import CameraImage
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.runtime.backends.gatekeeper import GatekeeperBackend
from dualbrain.runtime.planning import camera
from dualbrain.runtime.session import RunObserver, Session
from tests.planner.backends.test_image_requests import FOLDER
from tests.stories.story_session import contract_text, hold_contract, make_clocks, run_config, run_session

HOLD = contract_text(("hold", {"duration": 0.2}))
PLAN = ("plan", "put the red cube in the bowl", "--scene", "bare:0", "--memory", "off", "--knowledge", "off")


class ImagePlanner(ScriptedPlanner):
    """A scripted planner that takes images."""

    takes_images = True


class SyntheticCamera(nullcontext):
    """A camera without a GL library: the image has the colour of the time of the plant."""

    def __init__(self, plant, *, width, height):
        super().__init__(self)
        self.pixels = np.full((height, width, 3), int(10 * plant.now), np.uint8)

    def capture(self):
        return self.pixels


@pytest.fixture(autouse=True)
def synthetic_camera(monkeypatch):
    monkeypatch.setattr(camera, "Camera", SyntheticCamera)


@pytest.fixture
def script(monkeypatch):
    """Sets the planner that the command will open."""

    def answering(kind):
        planner = kind((hold_contract(),))
        monkeypatch.setattr(open_planner, "open_planner", lambda *_, **__: planner)
        return planner

    return answering


def test_plan_sends_the_image_of_the_camera_and_reports_it(run_command, script):
    planner = script(ImagePlanner)
    _, out, err = run_command(*PLAN, "--image", "--json")
    image = planner.requests[0].image
    assert isinstance(image, CameraImage), err
    assert json.loads(out)["image"] == {"type": "image/png", "bytes": len(image.data), "sha256": image.sha256}


def test_plan_sends_a_file_unchanged_and_prints_its_hash(run_command, script):
    planner = script(ImagePlanner)
    _, out, _ = run_command(*PLAN, "--image-file", FOLDER / "scene.png")
    assert planner.requests[0].image.data == (FOLDER / "scene.png").read_bytes()
    assert planner.requests[0].image.sha256 in out


def test_plan_without_an_image_sends_none(run_command, script):
    planner = script(ImagePlanner)
    _, out, _ = run_command(*PLAN, "--json")
    assert planner.requests[0].image is None
    assert "image" not in json.loads(out)


def test_a_planner_that_takes_no_image_is_not_asked(run_command, script):
    planner = script(ScriptedPlanner)
    code, out, err = run_command(*PLAN, "--image-file", FOLDER / "scene.png")
    assert (code, out, planner.requests) == (ExitCode.SETUP, "", [])
    assert "The planner scripted takes no image." in err


@pytest.mark.parametrize(
    "options",
    [
        ("run", "x", "--image", "--live"),
        ("run", "x", "--image", "--utility"),
        ("run", "x", "--image", "--contract", "c.json"),
        (*PLAN, "--image", "--image-file", "x.png"),
    ],
    ids=["live", "utility", "contract", "two images"],
)
def test_options_that_exclude_an_image_are_named(run_command, options):
    code, _, err = run_command(*options)
    assert code == ExitCode.USAGE
    assert "--image" in err
    assert "Leave out" in err


def test_a_run_sends_the_current_image_with_each_request_and_keeps_it(tmp_path, monkeypatch):
    monkeypatch.setattr("tests.stories.story_session.ScriptedPlanner", ImagePlanner)
    config = run_config(tmp_path, image=True, visuals=True)
    story = run_session(config, "no contract", HOLD)
    first, second = [request.image for request in story.planner.requests]
    assert first is second
    assert (story.config.out / "planner_image-1.png").read_bytes() == first.data
    assert json.loads((story.config.out / "config.json").read_text())["image"] is True


def test_a_run_whose_planner_takes_no_image_does_not_begin(tmp_path):
    with pytest.raises(ConfigurationError, match="takes no image"):
        run_session(run_config(tmp_path, image=True), HOLD)
    assert not (tmp_path / "run").exists()


def test_a_gatekeeper_refuses_a_run_with_images(tmp_path):
    config = replace(run_config(tmp_path), image=True)
    with (
        Session(config, make_clocks(), {}, ImagePlanner((HOLD,)), GatekeeperBackend()) as session,
        pytest.raises(ConfigurationError, match="no camera"),
    ):
        session.run(RunObserver())
