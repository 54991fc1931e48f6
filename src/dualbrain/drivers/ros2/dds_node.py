"""The node over DDS: topics and qualities of service as ros2_control has them, and the loop.

| topic | type | quality of service |
|---|---|---|
| joint states (in) | JointState | sensor data: best effort, volatile |
| commands (in) | Float64MultiArray, TwistStamped | best effort, newest only; matches reliable publishers as well |
| commands (in) | JointTrajectory | reliable |
| robot description (in) | String | reliable, transient local |
| safe commands (out) | Float64MultiArray | reliable, newest only |
| /diagnostics (out, 1 Hz), NODE/markers (out, 5 Hz) | DiagnosticArray, MarkerArray | reliable |
| /clock (in, with use_sim_time) | Clock | best effort |
"""

# cyclonedds states its types in part only
# pyright: reportUnknownArgumentType=false, reportUnknownMemberType=false, reportUnknownVariableType=false

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from math import inf
from typing import Any

import numpy as np
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsParticipant, BuiltinTopicDcpsPublication
from cyclonedds.core import InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from dualbrain.drivers.ros2 import dds_types as ros
from dualbrain.drivers.ros2.closest_points import ClosestPoints, closest_points
from dualbrain.drivers.ros2.command_filter import CommandFilter, Diagnosis
from dualbrain.drivers.ros2.command_sources import TwistMessage
from dualbrain.drivers.ros2.joint_order import JointStates
from dualbrain.drivers.ros2.parameters import absolute_topic
from dualbrain.drivers.ros2.problems import Level
from dualbrain.drivers.ros2.ros_clock import RosClock
from dualbrain.drivers.ros2.trajectory import TrajectoryMessage, TrajectoryPoint

DIAGNOSTICS_INTERVAL, MARKERS_INTERVAL, DISCOVERY_INTERVAL = 1.0, 0.2, 0.2
"""Times [s] between two diagnostic messages, marker messages and searches for other publishers."""
MIN_STOP_TIME = 3.0
"""Time [s] for which the node may brake the arm before it ends, also if the limits need less."""
STOP_TIME_FACTOR = 2.0
"""Longest time of braking, relative to that from the velocity limits to rest."""
MAX_SAMPLES, MAX_ENDPOINTS = 64, 4096
LINE_LIST = 5
"""`visualization_msgs/Marker.LINE_LIST`."""
NEAR = 0.3
"""Distance [m] below which the marker of closest points is red."""

_VOLATILE, _RELIABLE = Policy.Durability.Volatile, Policy.Reliability.Reliable(duration(milliseconds=100))
SENSOR_DATA = Qos(Policy.Reliability.BestEffort, _VOLATILE, Policy.History.KeepLast(5))
NEWEST = Qos(Policy.Reliability.BestEffort, _VOLATILE, Policy.History.KeepLast(1))
RELIABLE = Qos(_RELIABLE, _VOLATILE, Policy.History.KeepLast(10))
RELIABLE_NEWEST = Qos(_RELIABLE, _VOLATILE, Policy.History.KeepLast(1))
LATCHED = Qos(_RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1))


def _velocity(message: ros.Float64MultiArray) -> Sequence[float]:
    return message.data


def _trajectory(message: ros.JointTrajectory) -> TrajectoryMessage:
    points = tuple(
        TrajectoryPoint(
            point.positions, point.velocities, point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
        )
        for point in message.points
    )
    return TrajectoryMessage(tuple(message.joint_names), points, message.header.stamp.seconds)


def _twist(message: ros.TwistStamped) -> TwistMessage:
    linear, angular = message.twist.linear, message.twist.angular
    return TwistMessage(
        (linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z), message.header.frame_id.lstrip("/")
    )


COMMANDS: dict[str, tuple[Any, Qos, Callable[[Any], Any]]] = {
    "velocity": (ros.Float64MultiArray, NEWEST, _velocity),
    "trajectory": (ros.JointTrajectory, RELIABLE, _trajectory),
    "twist": (ros.TwistStamped, NEWEST, _twist),
}
"""Message type, quality of service and conversion of each `command_type`."""


class DdsNode:
    """The node: `run` guards commands until it has to stop, then brings the arm to rest."""

    def __init__(self, core: CommandFilter, name: str, domain: int) -> None:
        """Join the DDS `domain` (ROS_DOMAIN_ID) as the node called `name`."""
        self._core, self._name = core, name
        parameters = core.parameters
        self._clock = RosClock(use_sim_time=parameters.use_sim_time)
        participant = self._participant = DomainParticipant(domain)
        kind, quality, self._convert = COMMANDS[parameters.command_type]
        self._commands = self._reader(parameters.command_topic, kind, quality)
        self._states = self._reader(parameters.joint_states_topic, ros.JointState, SENSOR_DATA)
        self._descriptions = self._reader(parameters.robot_description_topic, ros.String, LATCHED)
        self._clocks = self._reader("/clock", ros.Clock, NEWEST) if parameters.use_sim_time else None
        self._safe = self._writer(parameters.safe_command_topic, ros.Float64MultiArray, RELIABLE_NEWEST)
        self._diagnostics = self._writer("/diagnostics", ros.DiagnosticArray, RELIABLE)
        self._markers = self._writer(f"/{name}/markers", ros.MarkerArray, RELIABLE_NEWEST)
        self._publications = BuiltinDataReader(participant, BuiltinTopicDcpsPublication)
        self._participants = BuiltinDataReader(participant, BuiltinTopicDcpsParticipant)
        self._alive = [
            ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Alive)
            for reader in (self._publications, self._participants)
        ]
        self._wait = WaitSet(participant)
        self._arrivals = [
            ReadCondition(reader, SampleState.NotRead | ViewState.Any | InstanceState.Alive)
            for reader in (self._states, self._commands)
        ]
        for condition in self._arrivals:
            self._wait.attach(condition)
        self._due = {"diagnostics": 0.0, "markers": 0.0, "discovery": 0.0}
        self._latencies: list[float] = []
        self._last: list[float] = []
        self._turn_begin, self._sent_at = -inf, -inf  # of this turn, and of the one that sent `_last` [s, monotonic]

    def _reader(self, topic: str, kind: Any, quality: Qos) -> Any:
        name = ros.topic_name(absolute_topic(topic))
        return DataReader(self._participant, Topic(self._participant, name, kind, qos=quality), qos=quality)

    def _writer(self, topic: str, kind: Any, quality: Qos) -> Any:
        name = ros.topic_name(absolute_topic(topic))
        return DataWriter(self._participant, Topic(self._participant, name, kind, qos=quality), qos=quality)

    # --- the loop -----------------------------------------------------------------------------------------------

    def run(self, is_stopped: Callable[[], bool], seconds: float = inf) -> None:
        """Guard commands until `is_stopped()`, or for `seconds`; the arm comes to rest at the end, also of an error."""
        end = time.monotonic() + seconds
        try:
            while not is_stopped() and time.monotonic() < end:
                self._wait.wait(duration(seconds=self._core.parameters.period))
                self._turn()
        finally:
            self._stop()

    def _turn(self) -> None:
        """Take all messages, step, and report."""
        begin = self._turn_begin = time.monotonic()
        clock_problem = self._read_clock(begin)
        if text := _newest(self._descriptions):
            self._core.description.receive(text.data)
        if self._clock.started:
            self._read_commands()
            self._send(self._read_states(begin))
        if clock_problem and not self._clock.started:
            self._core.problems.note(Level.STALE, "clock", clock_problem)
        elif clock_problem:
            self._brake_without_clock(clock_problem)
        elif self._clock.started:
            self._send(self._core.idle(self._clock.elapsed))
        self._report(time.monotonic())

    def _read_clock(self, monotonic: float) -> str:
        """Read the clock; a jump restarts the order of the stamps. Returns why there is no time now, or ""."""
        if self._clocks is None:
            jump = self._clock.read(time.time(), monotonic)
        else:
            message = _newest(self._clocks)
            jump = self._clock.receive(message.clock.seconds, monotonic) if message else ""
        if jump:
            self._core.restart_clock(jump, self._clock.elapsed)
        return self._clock.read(time.time(), monotonic) if self._clocks is not None else ""

    def _read_commands(self) -> None:
        for message in _samples(self._commands):
            self._core.receive_command(self._convert(message), self._clock.elapsed, self._clock.ros)

    def _read_states(self, begin: float) -> list[float] | None:
        """Take all joint states in their order; the newest velocities, because older ones are already late."""
        velocities = None
        for message in _samples(self._states):
            states = JointStates(message.name, message.position, message.velocity, message.header.stamp.seconds)
            found = self._core.receive_states(states, self._clock.elapsed, self._clock.ros)
            velocities = velocities if found is None else found
        if velocities is not None:
            self._latencies.append(time.monotonic() - begin)
        return velocities

    def _brake_without_clock(self, problem: str) -> None:
        """Brake one step if a period has passed since the last command: messages may wake the node more often."""
        now, period = self._clock.elapsed, self._core.parameters.period
        if self._turn_begin - self._sent_at < period:
            self._core.refuse("clock", problem, now, Level.STALE)
        else:
            self._send(self._core.brake("clock", problem, now, Level.STALE))

    def _send(self, velocities: list[float] | None) -> None:
        if velocities is not None:
            self._last, self._sent_at = velocities, self._turn_begin
            self._safe.write(ros.Float64MultiArray(data=velocities))

    def _stop(self) -> None:
        """Brake without joint states until the last command is zero, and end with zero: the controller keeps it."""
        text = "The node ends; the arm comes to rest. Remedy: none"
        end = time.monotonic() + self._stop_time()
        try:
            while any(self._last) and time.monotonic() < end:
                time.sleep(self._core.parameters.period)
                self._send(self._core.brake("end", text, self._clock.elapsed, Level.WARN))
        finally:
            self._send([0.0] * len(self._last) or None)

    def _stop_time(self) -> float:
        """Longest time [s] of braking at the end."""
        joints = self._core.safety.robot_model.joints
        return max(MIN_STOP_TIME, STOP_TIME_FACTOR * max(one.velocity.value / one.acceleration.value for one in joints))

    # --- reports ------------------------------------------------------------------------------------------------

    def _report(self, now: float) -> None:
        if self._is_due("discovery", DISCOVERY_INTERVAL, now):
            parameters = self._core.parameters
            others, sources = (
                self._writers(topic) for topic in (parameters.safe_command_topic, parameters.command_topic)
            )
            self._core.report_writers(others, sources)
        if self._is_due("markers", MARKERS_INTERVAL, now) and self._markers.get_matched_subscriptions():
            self._publish_markers()
        if self._is_due("diagnostics", DIAGNOSTICS_INTERVAL, now):
            diagnosis = self._core.diagnose(self._clock.elapsed)
            self._diagnostics.write(self._diagnostic_message(diagnosis))
            self._latencies.clear()

    def _publish_markers(self) -> None:
        if self._core.q is not None:
            points = closest_points(self._core.safety, self._core.q)
            self._markers.write(make_markers(points, self._core.description.base_frame, self._clock.ros))

    def _is_due(self, name: str, interval: float, now: float) -> bool:
        due = now >= self._due[name]
        if due:
            self._due[name] = now + interval
        return due

    def _writers(self, topic: str) -> tuple[str, ...]:
        """Descriptions of all publishers on `topic` but the node itself."""
        name, own = ros.topic_name(absolute_topic(topic)), self._safe.guid
        found = [
            endpoint
            for endpoint in self._publications.read(MAX_ENDPOINTS, condition=self._alive[0])
            if not isinstance(endpoint, InvalidSample) and endpoint.topic_name == name and endpoint.key != own
        ]
        return tuple(self._describe_participant(endpoint.participant_key) for endpoint in found)

    def _describe_participant(self, key: Any) -> str:
        """Process and host of a participant, as far as its DDS implementation states them."""
        for participant in self._participants.read(MAX_ENDPOINTS, condition=self._alive[1]):
            if isinstance(participant, InvalidSample) or participant.key != key:
                continue
            stated = {policy.key: policy.value for policy in participant.qos if isinstance(policy, Policy.Property)}
            if "__Pid" in stated:
                return f"Process {stated['__Pid']} ({stated.get('__ProcessName')}, {stated.get('__Hostname')})"
        return f"DDS participant {key}"

    def _diagnostic_message(self, diagnosis: Diagnosis) -> Any:
        latencies = 1e3 * np.array(self._latencies or [np.nan])
        timing = (
            ("time from state to command, median [ms]", f"{np.median(latencies):.3f}"),
            ("time from state to command, longest [ms]", f"{np.max(latencies):.3f}"),
        )
        status = ros.DiagnosticStatus(
            level=int(diagnosis.level),
            name=f"{self._name}: safety filter",
            message=diagnosis.message,
            hardware_id=self._core.safety.robot_model.name,
            values=[ros.KeyValue(key=key, value=value) for key, value in (*diagnosis.values, *timing)],
        )
        return ros.DiagnosticArray(header=ros.Header(stamp=ros.Time.at(self._clock.ros)), status=[status])


def make_markers(points: Sequence[ClosestPoints], frame: str, now: float) -> Any:
    """One line per obstacle between the closest points, red below 0.3 m."""
    header = ros.Header(stamp=ros.Time.at(now), frame_id=frame)
    markers = [
        ros.Marker(
            header=header,
            ns="closest points",
            id=index,
            type=LINE_LIST,
            scale=ros.Vector3(x=0.005),
            color=ros.ColorRGBA(r=1.0 if one.distance < NEAR else 0.2, g=0.2 if one.distance < NEAR else 1.0, a=1.0),
            lifetime=ros.Duration(sec=1),
            points=[ros.Point(x=x, y=y, z=z) for x, y, z in (one.on_robot.tolist(), one.on_obstacle.tolist())],
            text=one.obstacle,
        )
        for index, one in enumerate(points)
    ]
    return ros.MarkerArray(markers=markers)


def _samples(reader: Any) -> list[Any]:
    """All new messages in the order of their arrival; a notice about a publisher that left is none."""
    return [sample for sample in reader.take(N=MAX_SAMPLES) if not isinstance(sample, InvalidSample)]


def _newest(reader: Any) -> Any:
    """The newest message, or None."""
    found = _samples(reader)
    return found[-1] if found else None
