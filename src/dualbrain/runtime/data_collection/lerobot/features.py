"""Features of the dataset: name, type, shape and the names of the entries, as in the `features` of meta/info.json."""

from __future__ import annotations

from typing import Any

from dualbrain.robots.model import RobotModel
from dualbrain.runtime.data_collection.lerobot.frames import ActionKind

Feature = dict[str, Any]

BASE_CONFIGURATION = ("x", "y", "theta")
"""Names of the configuration of a mobile base."""
INDEX_FEATURES: dict[str, Feature] = {
    "timestamp": {"dtype": "float32", "shape": [1], "names": None},
    "frame_index": {"dtype": "int64", "shape": [1], "names": None},
    "episode_index": {"dtype": "int64", "shape": [1], "names": None},
    "index": {"dtype": "int64", "shape": [1], "names": None},
    "task_index": {"dtype": "int64", "shape": [1], "names": None},
}
"""Features that every LeRobot dataset has."""
INTERVENTION = "intervention"
"""LeRobot's own feature for frames in which the policy was overridden (its rollouts with corrections write it)."""


def dataset_features(robot_model: RobotModel, action: ActionKind, *, has_opening: bool) -> dict[str, Feature]:
    """The features of a dataset of `robot_model`; `has_opening`: the opening of the fingers is known in all frames."""
    joints = [joint.name for joint in robot_model.joints]
    velocities = [f"{name}.vel" for name in joints]
    positions = [f"{name}.pos" for name in configuration_names(robot_model)]
    features = {
        "observation.state": _vector(positions),
        "action": _vector(velocities if action == "velocity" else positions),
        "dualbrain.u_nom": _vector(velocities),
        "dualbrain.delta": _scalar("float32"),
        "dualbrain.h_min": _scalar("float32"),
        "dualbrain.status": _scalar("int64"),
        INTERVENTION: _scalar("bool"),
    }
    if has_opening:
        features["dualbrain.opening"] = _scalar("float32")
    return features | {name: dict(feature) for name, feature in INDEX_FEATURES.items()}


def configuration_names(robot_model: RobotModel) -> list[str]:
    """Names of the entries of q: the joints; of a mobile base x, y and theta instead of its two velocities."""
    joints = [joint.name for joint in robot_model.joints]
    return [*BASE_CONFIGURATION, *joints[2:]] if robot_model.is_mobile else joints


def _vector(names: list[str]) -> Feature:
    return {"dtype": "float32", "shape": [len(names)], "names": names}


def _scalar(dtype: str) -> Feature:
    return {"dtype": dtype, "shape": [1], "names": None}
