"""Safety layer: barriers, the CBF-QP filter, the supervisor above the filter, and integrations with other software."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dualbrain.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dualbrain.core.geometry.distance import signed_distance
    from dualbrain.robots.site_config import SiteFile, read_site
    from dualbrain.safety.barriers.scenarios import EXACT_TRACKING
    from dualbrain.safety.cbf.batch import BatchResult
    from dualbrain.safety.cbf.config import FilterConfig, operating_config
    from dualbrain.safety.cbf.filter import SafetyFilter, ToolState
    from dualbrain.safety.cbf.obstacles import Contact, NearSpeed, Obstacle, PersonLimits, SpeedAndSeparation
    from dualbrain.safety.cbf.result import FilterResult, FilterStatus
    from dualbrain.safety.cbf.rows import BarrierRow, ConstraintRow, PythonBarrier, Rank
    from dualbrain.safety.control_thread import ControlThread, ControlThreadConfig, ControlThreadStatus
    from dualbrain.safety.integration.derating import derate
    from dualbrain.safety.integration.gym_env import FilteredEnv
    from dualbrain.safety.integration.intervention_log import (
        InterventionInterval,
        InterventionLog,
        read_intervention_log,
    )
    from dualbrain.safety.integration.point_clouds.pinhole_camera import PinholeCamera
    from dualbrain.safety.integration.point_clouds.point_cloud_source import (
        CloudReport,
        PointCloudConfig,
        PointCloudSource,
    )
    from dualbrain.safety.integration.policy_guard.action_layout import ActionLayout
    from dualbrain.safety.integration.policy_guard.guard import GuardLimits, GuardReport, PolicyGuard
    from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition, JointVelocity
    from dualbrain.safety.integration.policy_guard.tool_actions import ToolPose, ToolTwist
    from dualbrain.safety.integration.policy_guard.torque_actions import JointTorque, TorqueDrive
    from dualbrain.safety.integration.power_and_force import (
        BODY_REGIONS,
        BodyRegion,
        contact_speed,
        effective_mass,
        transfer_energy,
    )
    from dualbrain.safety.integration.scene_fusion import (
        FrameMount,
        PerceivedShape,
        SceneFusion,
        SceneSource,
        SourceAccepted,
        SourceRefused,
    )
    from dualbrain.safety.integration.shadow_mode import ShadowFilter, ShadowSummary
    from dualbrain.safety.integration.site import site_filter, site_persons
    from dualbrain.safety.stop_cause import Evidence, Reason, StopCause
    from dualbrain.safety.supervisor.actions import SafetyAction, SupervisorDecision
    from dualbrain.safety.supervisor.controller import SafetyController

_MODULES = {
    "core.geometry.distance": ("signed_distance",),
    "robots.site_config": (
        "SiteFile",
        "read_site",
    ),
    "safety.barriers.scenarios": ("EXACT_TRACKING",),
    "safety.cbf.batch": ("BatchResult",),
    "safety.cbf.config": (
        "FilterConfig",
        "operating_config",
    ),
    "safety.cbf.filter": (
        "SafetyFilter",
        "ToolState",
    ),
    "safety.cbf.obstacles": (
        "Contact",
        "NearSpeed",
        "Obstacle",
        "PersonLimits",
        "SpeedAndSeparation",
    ),
    "safety.cbf.result": (
        "FilterResult",
        "FilterStatus",
    ),
    "safety.cbf.rows": (
        "BarrierRow",
        "ConstraintRow",
        "PythonBarrier",
        "Rank",
    ),
    "safety.control_thread": ("ControlThread", "ControlThreadConfig", "ControlThreadStatus"),
    "safety.integration.derating": ("derate",),
    "safety.integration.gym_env": ("FilteredEnv",),
    "safety.integration.intervention_log": (
        "InterventionInterval",
        "InterventionLog",
        "read_intervention_log",
    ),
    "safety.integration.point_clouds.pinhole_camera": ("PinholeCamera",),
    "safety.integration.point_clouds.point_cloud_source": (
        "CloudReport",
        "PointCloudConfig",
        "PointCloudSource",
    ),
    "safety.integration.policy_guard.action_layout": ("ActionLayout",),
    "safety.integration.policy_guard.guard": (
        "GuardLimits",
        "GuardReport",
        "PolicyGuard",
    ),
    "safety.integration.policy_guard.joint_actions": (
        "JointPosition",
        "JointVelocity",
    ),
    "safety.integration.policy_guard.tool_actions": (
        "ToolPose",
        "ToolTwist",
    ),
    "safety.integration.policy_guard.torque_actions": (
        "JointTorque",
        "TorqueDrive",
    ),
    "safety.integration.power_and_force": (
        "BODY_REGIONS",
        "BodyRegion",
        "contact_speed",
        "effective_mass",
        "transfer_energy",
    ),
    "safety.integration.scene_fusion": (
        "FrameMount",
        "PerceivedShape",
        "SceneFusion",
        "SceneSource",
        "SourceAccepted",
        "SourceRefused",
    ),
    "safety.integration.shadow_mode": (
        "ShadowFilter",
        "ShadowSummary",
    ),
    "safety.integration.site": (
        "site_filter",
        "site_persons",
    ),
    "safety.stop_cause": (
        "Evidence",
        "Reason",
        "StopCause",
    ),
    "safety.supervisor.actions": (
        "SafetyAction",
        "SupervisorDecision",
    ),
    "safety.supervisor.controller": ("SafetyController",),
}
"""Public names by the module that defines them."""

__all__ = [
    "BODY_REGIONS",
    "EXACT_TRACKING",
    "ActionLayout",
    "BarrierRow",
    "BatchResult",
    "BodyRegion",
    "CloudReport",
    "ConstraintRow",
    "Contact",
    "ControlThread",
    "ControlThreadConfig",
    "ControlThreadStatus",
    "Evidence",
    "FilterConfig",
    "FilterResult",
    "FilterStatus",
    "FilteredEnv",
    "FrameMount",
    "GuardLimits",
    "GuardReport",
    "InterventionInterval",
    "InterventionLog",
    "JointPosition",
    "JointTorque",
    "JointVelocity",
    "NearSpeed",
    "Obstacle",
    "PerceivedShape",
    "PersonLimits",
    "PinholeCamera",
    "PointCloudConfig",
    "PointCloudSource",
    "PolicyGuard",
    "PythonBarrier",
    "Rank",
    "Reason",
    "SafetyAction",
    "SafetyController",
    "SafetyFilter",
    "SceneFusion",
    "SceneSource",
    "ShadowFilter",
    "ShadowSummary",
    "SiteFile",
    "SourceAccepted",
    "SourceRefused",
    "SpeedAndSeparation",
    "StopCause",
    "SupervisorDecision",
    "ToolPose",
    "ToolState",
    "ToolTwist",
    "TorqueDrive",
    "contact_speed",
    "derate",
    "effective_mass",
    "operating_config",
    "read_intervention_log",
    "read_site",
    "signed_distance",
    "site_filter",
    "site_persons",
    "transfer_energy",
]

__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
