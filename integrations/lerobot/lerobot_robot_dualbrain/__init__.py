"""LeRobot plugin: a robot that guards any other robot, `--robot.type=dualbrain_guarded`, and a processor step.

LeRobot imports every installed distribution whose name begins with `lerobot_robot_`, so installing this one registers
both. All commands of LeRobot, the asynchronous client too, end in `Robot.send_action`, where the guard is.
"""

from lerobot_robot_dualbrain.config_dualbrain_guarded import DualbrainGuardedConfig
from lerobot_robot_dualbrain.dualbrain_guarded import DualbrainGuarded
from lerobot_robot_dualbrain.safety_filter_step import DualbrainSafetyFilterStep

__all__ = ["DualbrainGuarded", "DualbrainGuardedConfig", "DualbrainSafetyFilterStep"]
