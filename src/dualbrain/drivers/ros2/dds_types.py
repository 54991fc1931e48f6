"""Messages of ROS 2 as DDS types of `cyclonedds`.

A topic `/joint_states` is `rt/joint_states` in DDS, and `sensor_msgs/msg/JointState` is the type
`sensor_msgs::msg::dds_::JointState_`. The fields have the order of the message definitions, in which they are sent.
"""

# cyclonedds reads the annotations when a class is made, so this module must not postpone their evaluation

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from cyclonedds.idl import IdlStruct

if TYPE_CHECKING:
    from builtins import float as float32
    from builtins import float as float64
    from builtins import int as byte
    from builtins import int as int32
    from builtins import int as uint8
    from builtins import int as uint32
    from builtins import list as sequence
else:
    from cyclonedds.idl.types import byte, float32, float64, int32, sequence, uint8, uint32


def dds_name(package: str, message: str) -> str:
    """The DDS name of a message type of ROS."""
    return f"{package}::msg::dds_::{message}_"


def topic_name(topic: str) -> str:
    """The DDS name of the topic called `topic`, with its leading slash, in ROS."""
    return f"rt{topic}"


@dataclass(kw_only=True)
class Time(IdlStruct, typename=dds_name("builtin_interfaces", "Time")):
    """`builtin_interfaces/Time`."""

    sec: int32 = 0
    nanosec: uint32 = 0

    @property
    def seconds(self) -> float:
        """The time [s]."""
        return self.sec + 1e-9 * self.nanosec

    @classmethod
    def at(cls, seconds: float) -> "Time":
        """The time at `seconds`."""
        whole = int(seconds // 1.0)
        return cls(sec=whole, nanosec=min(int((seconds - whole) * 1e9), 999_999_999))


@dataclass(kw_only=True)
class Duration(IdlStruct, typename=dds_name("builtin_interfaces", "Duration")):
    """`builtin_interfaces/Duration`."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass(kw_only=True)
class Header(IdlStruct, typename=dds_name("std_msgs", "Header")):
    """`std_msgs/Header`."""

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass(kw_only=True)
class String(IdlStruct, typename=dds_name("std_msgs", "String")):
    """`std_msgs/String`."""

    data: str = ""


@dataclass(kw_only=True)
class Clock(IdlStruct, typename=dds_name("rosgraph_msgs", "Clock")):
    """`rosgraph_msgs/Clock`."""

    clock: Time = field(default_factory=Time)


@dataclass(kw_only=True)
class JointState(IdlStruct, typename=dds_name("sensor_msgs", "JointState")):
    """`sensor_msgs/JointState`."""

    header: Header = field(default_factory=Header)
    name: sequence[str] = field(default_factory=list[str])
    position: sequence[float64] = field(default_factory=list[float64])
    velocity: sequence[float64] = field(default_factory=list[float64])
    effort: sequence[float64] = field(default_factory=list[float64])


@dataclass(kw_only=True)
class MultiArrayDimension(IdlStruct, typename=dds_name("std_msgs", "MultiArrayDimension")):
    """`std_msgs/MultiArrayDimension`."""

    label: str = ""
    size: uint32 = 0
    stride: uint32 = 0


@dataclass(kw_only=True)
class MultiArrayLayout(IdlStruct, typename=dds_name("std_msgs", "MultiArrayLayout")):
    """`std_msgs/MultiArrayLayout`."""

    dim: sequence[MultiArrayDimension] = field(default_factory=list[MultiArrayDimension])
    data_offset: uint32 = 0


@dataclass(kw_only=True)
class Float64MultiArray(IdlStruct, typename=dds_name("std_msgs", "Float64MultiArray")):
    """`std_msgs/Float64MultiArray`."""

    layout: MultiArrayLayout = field(default_factory=MultiArrayLayout)
    data: sequence[float64] = field(default_factory=list[float64])


@dataclass(kw_only=True)
class Vector3(IdlStruct, typename=dds_name("geometry_msgs", "Vector3")):
    """`geometry_msgs/Vector3`."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass(kw_only=True)
class Point(IdlStruct, typename=dds_name("geometry_msgs", "Point")):
    """`geometry_msgs/Point`."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass(kw_only=True)
class Quaternion(IdlStruct, typename=dds_name("geometry_msgs", "Quaternion")):
    """`geometry_msgs/Quaternion`."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass(kw_only=True)
class Pose(IdlStruct, typename=dds_name("geometry_msgs", "Pose")):
    """`geometry_msgs/Pose`."""

    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass(kw_only=True)
class Twist(IdlStruct, typename=dds_name("geometry_msgs", "Twist")):
    """`geometry_msgs/Twist`."""

    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass(kw_only=True)
class TwistStamped(IdlStruct, typename=dds_name("geometry_msgs", "TwistStamped")):
    """`geometry_msgs/TwistStamped`."""

    header: Header = field(default_factory=Header)
    twist: Twist = field(default_factory=Twist)


@dataclass(kw_only=True)
class JointTrajectoryPoint(IdlStruct, typename=dds_name("trajectory_msgs", "JointTrajectoryPoint")):
    """`trajectory_msgs/JointTrajectoryPoint`."""

    positions: sequence[float64] = field(default_factory=list[float64])
    velocities: sequence[float64] = field(default_factory=list[float64])
    accelerations: sequence[float64] = field(default_factory=list[float64])
    effort: sequence[float64] = field(default_factory=list[float64])
    time_from_start: Duration = field(default_factory=Duration)


@dataclass(kw_only=True)
class JointTrajectory(IdlStruct, typename=dds_name("trajectory_msgs", "JointTrajectory")):
    """`trajectory_msgs/JointTrajectory`."""

    header: Header = field(default_factory=Header)
    joint_names: sequence[str] = field(default_factory=list[str])
    points: sequence[JointTrajectoryPoint] = field(default_factory=list[JointTrajectoryPoint])


@dataclass(kw_only=True)
class KeyValue(IdlStruct, typename=dds_name("diagnostic_msgs", "KeyValue")):
    """`diagnostic_msgs/KeyValue`."""

    key: str = ""
    value: str = ""


@dataclass(kw_only=True)
class DiagnosticStatus(IdlStruct, typename=dds_name("diagnostic_msgs", "DiagnosticStatus")):
    """`diagnostic_msgs/DiagnosticStatus`."""

    level: byte = 0
    name: str = ""
    message: str = ""
    hardware_id: str = ""
    values: sequence[KeyValue] = field(default_factory=list[KeyValue])


@dataclass(kw_only=True)
class DiagnosticArray(IdlStruct, typename=dds_name("diagnostic_msgs", "DiagnosticArray")):
    """`diagnostic_msgs/DiagnosticArray`."""

    header: Header = field(default_factory=Header)
    status: sequence[DiagnosticStatus] = field(default_factory=list[DiagnosticStatus])


@dataclass(kw_only=True)
class ColorRGBA(IdlStruct, typename=dds_name("std_msgs", "ColorRGBA")):
    """`std_msgs/ColorRGBA`."""

    r: float32 = 0.0
    g: float32 = 0.0
    b: float32 = 0.0
    a: float32 = 0.0


@dataclass(kw_only=True)
class CompressedImage(IdlStruct, typename=dds_name("sensor_msgs", "CompressedImage")):
    """`sensor_msgs/CompressedImage`, which a marker contains."""

    header: Header = field(default_factory=Header)
    format: str = ""
    data: sequence[uint8] = field(default_factory=list[uint8])


@dataclass(kw_only=True)
class UVCoordinate(IdlStruct, typename=dds_name("visualization_msgs", "UVCoordinate")):
    """`visualization_msgs/UVCoordinate`."""

    u: float32 = 0.0
    v: float32 = 0.0


@dataclass(kw_only=True)
class MeshFile(IdlStruct, typename=dds_name("visualization_msgs", "MeshFile")):
    """`visualization_msgs/MeshFile`."""

    filename: str = ""
    data: sequence[uint8] = field(default_factory=list[uint8])


@dataclass(kw_only=True)
class Marker(IdlStruct, typename=dds_name("visualization_msgs", "Marker")):
    """`visualization_msgs/Marker`."""

    header: Header = field(default_factory=Header)
    ns: str = ""
    id: int32 = 0
    type: int32 = 0
    action: int32 = 0
    pose: Pose = field(default_factory=Pose)
    scale: Vector3 = field(default_factory=Vector3)
    color: ColorRGBA = field(default_factory=ColorRGBA)
    lifetime: Duration = field(default_factory=Duration)
    frame_locked: bool = False
    points: sequence[Point] = field(default_factory=list[Point])
    colors: sequence[ColorRGBA] = field(default_factory=list[ColorRGBA])
    texture_resource: str = ""
    texture: CompressedImage = field(default_factory=CompressedImage)
    uv_coordinates: sequence[UVCoordinate] = field(default_factory=list[UVCoordinate])
    text: str = ""
    mesh_resource: str = ""
    mesh_file: MeshFile = field(default_factory=MeshFile)
    mesh_use_embedded_materials: bool = False


@dataclass(kw_only=True)
class MarkerArray(IdlStruct, typename=dds_name("visualization_msgs", "MarkerArray")):
    """`visualization_msgs/MarkerArray`."""

    markers: sequence[Marker] = field(default_factory=list[Marker])
