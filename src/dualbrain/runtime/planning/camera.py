"""The image of the robot's simulated camera for a planner."""

from __future__ import annotations

from dualbrain.planner.camera_image import MAX_HEIGHT, MAX_WIDTH, CameraImage, encode_camera_image
from dualbrain.simulation.perception.rendering import Camera
from dualbrain.simulation.plant.plant import Plant


def capture_camera_image(plant: Plant) -> CameraImage:
    """The present state of `plant`, seen by its front camera; raises `MissingDependencyError` without a GL library."""
    with Camera(plant, width=MAX_WIDTH, height=MAX_HEIGHT) as camera:
        return encode_camera_image(camera.capture())
