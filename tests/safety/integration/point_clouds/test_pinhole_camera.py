"""Projection and back projection are inverse, and calibrations that no camera has are refused."""

import numpy as np
import pytest

from dualbrain.errors import GeometryError
from dualbrain.safety.integration.point_clouds.pinhole_camera import PinholeCamera
from tests.safety.integration.point_clouds.rendered_boxes import CAMERA


def test_projection_inverts_back_projection():
    depth = np.random.default_rng(0).uniform(0.2, 3.0, (CAMERA.height, CAMERA.width))
    rows, columns, inside = CAMERA.project(CAMERA.back_project(depth, np.ones_like(depth, bool)))
    assert inside.all()
    assert np.array_equal(rows, np.repeat(np.arange(CAMERA.height), CAMERA.width))
    assert np.array_equal(columns, np.tile(np.arange(CAMERA.width), CAMERA.height))


def test_a_pixel_is_a_point_in_the_optical_frame():
    depth = np.zeros((CAMERA.height, CAMERA.width))
    depth[50, 70] = 2.0
    (point,) = CAMERA.back_project(depth, CAMERA.valid_pixels(depth))
    assert point == pytest.approx([2.0 * (70 - 39.5) / 60.0, 2.0 * (50 - 29.5) / 60.0, 2.0])


def test_points_behind_the_camera_or_beside_the_image_are_not_in_it():
    *_, inside = CAMERA.project(np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [9.0, 0.0, 1.0], [0.0, 0.0, 1.0]]))
    assert inside.tolist() == [False, False, False, True]


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0, 9.0])
def test_a_pixel_without_a_measurement_is_not_valid(value):
    assert not CAMERA.valid_pixels(np.full((60, 80), value)).any()


@pytest.mark.parametrize("field", [{"width": 0}, {"height": 1.5}, {"fx": 0.0}, {"fy": np.nan}, {"cx": np.inf}])
def test_a_calibration_that_no_camera_has_is_refused(field):
    values = {"width": 80, "height": 60, "fx": 60.0, "fy": 60.0, "cx": 40.0, "cy": 30.0}
    with pytest.raises(GeometryError, match=next(iter(field))):
        PinholeCamera(**(values | field))
