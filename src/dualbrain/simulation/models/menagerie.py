"""Adapts MuJoCo Menagerie's Panda to the convention of `load_mujoco_model`: drives, grip force, pads, gravity."""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from pathlib import Path

import mujoco

VELOCITY_GAINS = (1800.0, 1800.0, 1400.0, 1400.0, 200.0, 200.0, 200.0)
TORQUE_LIMITS = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
GRIPPER_KP, GRIPPER_KV = 20000.0, 140.0
PAD_CONTACT = {"friction": [1.5, 0.02, 0.0001], "condim": 4, "priority": 1, "solref": [0.005, 1]}


def find_menagerie_file(checkout: Path | None) -> Path | None:
    """The file of the Panda in a checkout or cache folder of Menagerie, or None if it is missing."""
    if checkout is None:
        return None
    found = checkout / "franka_emika_panda" / "panda.xml"
    return found if found.is_file() else None


def adapt_panda(robot: mujoco.MjSpec) -> mujoco.MjSpec:
    """Change drives, gripper, pads and gravity compensation of Menagerie's Panda in place; returns `robot`."""
    for element in [*robot.keys, *robot.lights, *robot.cameras]:
        robot.delete(element)
    for body in robot.bodies:
        if body.name not in ("world", "link0"):
            body.gravcomp = 1
    for index, (kv, torque) in enumerate(zip(VELOCITY_GAINS, TORQUE_LIMITS, strict=True), start=1):
        drive = robot.actuator(f"actuator{index}")
        drive.set_to_velocity(kv=kv)
        drive.ctrllimited, drive.forcerange, drive.group = False, [-torque, torque], 1
    _set_gripper(robot)
    for side in ("left", "right"):
        _set_pads(robot, side)
    robot.body("hand").add_site(name="tcp", pos=[0, 0, 0.1034], group=4)
    return robot


def _set_gripper(robot: mujoco.MjSpec) -> None:
    servo = robot.actuator("actuator8")
    servo.set_to_position(kp=GRIPPER_KP, kv=GRIPPER_KV)
    servo.name, servo.group = "gripper", 2
    servo.ctrlrange, servo.forcerange = [0, 0.04], [-40, 40]


def _set_pads(robot: mujoco.MjSpec, side: str) -> None:
    finger = robot.body(f"{side}_finger")
    boxes = [geom for geom in finger.geoms if int(geom.type) == int(mujoco.mjtGeom.mjGEOM_BOX)]
    for index, geom in enumerate(boxes):
        geom.name = f"{side}_pad{index or ''}"
        for key, value in PAD_CONTACT.items():
            setattr(geom, key, value)
    finger.add_site(
        name=f"{side}_touch",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0, 0.0035, 0.0448],
        size=[0.0105, 0.006, 0.011],
        group=5,
    )
    robot.add_sensor(
        name=f"{side}_touch",
        type=mujoco.mjtSensor.mjSENS_TOUCH,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname=f"{side}_touch",
    )
