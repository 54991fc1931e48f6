"""The gatekeeper: owns robot, skills, filter, supervisor and control tick; other processes send it requests.

In every tick it reads a bounded amount from the socket, passes contracts to the gate process, and reports the state of
the connections to the supervisor as conditions. A commander that dies, hangs, floods the socket or sends malformed
frames is a condition like any other.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import isnan

from msgspec.structs import replace

from dualbrain.contracts.contract import Contract, ContractHeader
from dualbrain.contracts.verdict import Accepted
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopInputs, LoopObserver, TickSnapshot
from dualbrain.control.gatekeeper.capability import Capability
from dualbrain.control.gatekeeper.gate.exchange import ContractGate, GateReply, GateRequest
from dualbrain.control.gatekeeper.operator_commands import OperatorCommands, is_allowed
from dualbrain.control.gatekeeper.protocol.authentication import Keys, verify_contract_mac, verify_hello_proof
from dualbrain.control.gatekeeper.protocol.messages import (
    CheckReport,
    CheckRequest,
    CountsReport,
    CountsRequest,
    EventReport,
    Heartbeat,
    Hello,
    Message,
    OperatorCommand,
    OutcomeReport,
    Propose,
    RequestRefused,
    SceneReport,
    SceneRequest,
    StatusReport,
    TickReport,
    VerdictReport,
    Welcome,
)
from dualbrain.control.gatekeeper.protocol.server import DISCONNECTED, FLOOD, Connection, SocketServer
from dualbrain.control.gatekeeper.robot_link.interface import RobotLink
from dualbrain.control.gatekeeper.timing.tick_counts import TickCounter
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.recording_pause import UNATTENDED_TIME, RecordingPause
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.records import ObjectLimits, Outcome
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle, PersonLimits
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.state_monitor import MonitorLimits
from dualbrain.safety.supervisor.timing import Timing
from dualbrain.skills.registry import skill_registry

OPERATOR = "operator"
"""Principal of the operator, a person with the operator's key."""
HEARTBEAT_TIMEOUT = 0.3
"""Time [s] without a message after which the commander counts as silent."""
AUTHENTICATION_TIMEOUT = 2.0
"""Time [s] after which a connection that has not authenticated itself is closed."""
FAULT_HOLD_TIME = 0.5
"""Time [s] for which the condition of a flood or of a refused message holds."""
STATUS_PERIOD, CLEANUP_PERIOD = 0.05, 10.0
"""Time between two status reports, and between two clean-ups while idle [s]."""
TICK_REPORT_PERIOD = 0.066
"""Time between two tick reports for observers [s]."""
MAX_CONTRACT_LIFETIME = 660.0
"""Longest time from issue to expiry of a contract [s]; a later expiry is cut."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GatekeeperSettings:
    """Settings of a gatekeeper that do not change while it runs.

    `timing`: limits on delays of the robot's interface. `speed_scale`: initial speed scale, (0, 1]. `fixed_obstacles`:
    obstacles of the site. `filter_config`: settings of the filter for this robot. `drive_initially_off`: the drive has
    to be switched on first. `unrecorded`: the arm may move on if the recording cannot be written. `persons`: speed
    limits near persons. `object_limits`: limits of objects by name or category. `monitor_limits`: of joint states.
    """

    timing: Timing
    speed_scale: float = 1.0
    fixed_obstacles: tuple[Obstacle, ...] = ()
    filter_config: FilterConfig | None = None
    persons: PersonLimits | None = None
    object_limits: Mapping[str, ObjectLimits] = field(default_factory=dict[str, ObjectLimits])
    drive_initially_off: bool = False
    unrecorded: bool = False
    monitor_limits: MonitorLimits | None = None


class Gatekeeper:
    """Owns one robot and one socket server, and accepts contracts from one commander at a time."""

    def __init__(
        self,
        robot_model: RobotModel,
        robot: RobotLink,
        server: SocketServer,
        gate: ContractGate,
        keys: Keys,
        capabilities: Mapping[str, Capability],
        *,
        settings: GatekeeperSettings,
        recorder: Recorder | None = None,
        trace: Trace | None = None,
        monotonic: Callable[[], float] = time.monotonic,
        on_outcome: Callable[[Outcome], None] = lambda outcome: None,
        mark_part: Callable[[str], None] = lambda part: None,
        safety: SafetyFilter | None = None,
    ) -> None:
        """Connect all parts; the robot holds position until a contract is accepted. `gate` checks the contracts.

        Connections are timed by `monotonic` [s]. `on_outcome` gets every outcome, `mark_part` the name of the part of a
        tick that has just ended. `safety` is the filter of the loop, by default one from `settings`.
        """
        self.robot, self.server, self.operator_commands = robot, server, OperatorCommands(settings.speed_scale)
        self._keys, self._capabilities = keys, dict(capabilities)
        self._gate, self._registry = gate, skill_registry(robot_model)
        self._trace = Trace(robot_model.n) if trace is None else trace
        self._log = FlightLog(self._trace, recorder, self._broadcast_event)
        self._counter = TickCounter()
        self._commander: Connection | None = None
        self._had_commander = self._commander_replaced = False
        self._recording_pause = RecordingPause()
        self._flood_until = self._refused_until = -1.0
        self._next_contract: Contract | None = None
        self._proposer: Connection | None = None
        self._dry_run = False
        self._waiting_request: GateRequest | None = None
        self._shutdown_requested, self._busy, self._ticks = False, False, 0
        self._drive_initially_off = settings.drive_initially_off
        self._monotonic, self._on_outcome = monotonic, on_outcome
        self._rate_buckets: dict[str, tuple[float, float]] = {}
        self._robot_model = robot_model
        self._status_period_ticks, self._cleanup_period_ticks = (
            max(1, round(t / robot_model.period)) for t in (STATUS_PERIOD, CLEANUP_PERIOD)
        )
        if safety is None:
            safety = SafetyFilter(robot_model, settings.filter_config, obstacles=settings.fixed_obstacles)
        robot.skip_to_newest_state()  # the preparations may have taken longer than a state remains valid
        self.loop = ControlLoop(
            robot_model,
            robot,
            robot,
            safety,
            self._log,
            ControlLoopConfig(
                snapshot_period=TICK_REPORT_PERIOD,
                timing=settings.timing,
                unrecorded=settings.unrecorded,
                persons=settings.persons,
                object_limits=settings.object_limits,
                monitor_limits=settings.monitor_limits,
            ),
            LoopObserver(
                on_tick=self._broadcast_tick,
                on_phase=robot.set_phase,
                mark_part=mark_part,
                on_result=self._counter.count_tick,
            ),
            LoopInputs(external_conditions=self._service_connections, clock=robot.clock),
        )
        self.executor = ContractExecutor(self.loop)
        self.loop.safety_controller.speed_scale = settings.speed_scale

    def run(self) -> None:
        """Tick until a shutdown is requested. No garbage is collected while a contract runs."""
        gc.collect()
        gc.freeze()
        gc.disable()
        self.robot.skip_to_newest_state()
        self.loop.begin()
        if self._drive_initially_off:
            self.robot.enable()
            self.loop.safety_controller.expect_drive_on(self.loop.state, self.robot.clock())
        while not self._shutdown_requested:
            contract, self._next_contract = self._next_contract, None
            if contract is not None:
                self._execute(contract)
            else:
                self.executor.hold(self._robot_model.period, "idle")
                if self._ticks % self._cleanup_period_ticks == 0:
                    self._trace.clear()
                    gc.collect(0)
        self._gate.close()
        gc.unfreeze()
        gc.enable()

    @property
    def busy(self) -> bool:
        """Whether a contract runs, is next, or is being checked by the gate in order to run."""
        waits = self._next_contract is not None or self._waiting_request is not None
        return self._busy or waits or (self._gate.busy and not self._dry_run)

    def shut_down(self) -> None:
        """End after this tick, or as soon as the robot has braked if a contract runs."""
        self._shutdown_requested = True

    def _execute(self, contract: Contract) -> None:
        self._trace.clear()
        self._log.binding.clear()
        self.robot.start_contract(contract)
        self._busy = True
        outcome = self.executor.execute(contract)
        self._busy = False
        self._counter.count_outcome(outcome.kind)
        self._on_outcome(outcome)
        if self._proposer in self.server.connections and self._proposer:
            self._proposer.send(OutcomeReport(outcome, dict(self._log.binding)))

    # --- once a tick --------------------------------------------------------------------------------------------

    def _service_connections(self) -> int:
        """Receive, reply, and return the `Condition` bits that hold; the control loop calls this in every tick."""
        now = self._monotonic()
        self._ticks += 1
        for connection, sequence, message in self.server.receive(now):
            self._dispatch(connection, sequence, message, now)
        for connection in self.server.failed_connections():
            self._on_disconnect(connection, now)
        if (reply := self._gate.take_reply()) is not None:
            self._apply_gate_reply(reply)
        if self._ticks % self._status_period_ticks == 0:
            self._send_status(now)
        self.loop.safety_controller.speed_scale = self.operator_commands.speed_scale
        self._pause_or_resume_recording(now)
        self._record_thread()
        return self._conditions(now)

    def _pause_or_resume_recording(self, now: float) -> None:
        """Record nothing while the arm is at rest without a commander for long; a replay is exact across the pause."""
        controller, stamp = self.loop.safety_controller, self.robot.read().stamp
        moving = controller.commanded_speed > controller.enforcement.limits.rest_velocity
        if self._recording_pause.update(now, active=self._commander is not None or self.busy or moving):
            self._log.pause(stamp, f"no commander was connected for {UNATTENDED_TIME:.0f} s, and the arm is at rest")
        elif self._log.resume(stamp):
            self._log.call(stamp, "reset", u_prev=controller.clear_filter_memory())

    def _record_thread(self) -> None:
        """Record the notes and, every status period, the ticks of a control thread."""
        stamp = self.robot.read().stamp
        for text in self.robot.notes():
            self._log.note(stamp, "control_thread", text)
        if self._ticks % self._status_period_ticks == 0 and (ticks := self.robot.thread_ticks()) is not None:
            self._log.thread_ticks(stamp, ticks)

    def _conditions(self, now: float) -> int:
        flags = self.operator_commands.conditions() | self.robot.conditions()
        replaced, self._commander_replaced = self._commander_replaced, False
        if replaced or (self._had_commander and self._commander is None):
            flags |= Condition.LINK_LOST
        elif self._commander is not None and now - self._commander.last_received_at > HEARTBEAT_TIMEOUT:
            flags |= Condition.HEARTBEAT_LOST
        if now < self._flood_until:
            flags |= Condition.FLOOD
        if now < self._refused_until:
            flags |= Condition.FRAMES_REFUSED
        return flags | (Condition.INTERRUPT if self._shutdown_requested and self._busy else 0)

    def _send_status(self, now: float) -> None:
        decision = self.loop.safety_controller.decision
        report = StatusReport(
            now=self.robot.clock(),
            action=decision.action.name,
            cause=decision.cause.value,
            check=decision.check,
            busy=self.busy,
            commander=self._commander is not None,
        )
        for connection in self.server.connections:
            if connection.role == "stranger" and now - connection.last_received_at > AUTHENTICATION_TIMEOUT:
                connection.fault = connection.fault or "not authenticated in time"
            elif connection.role != "stranger":
                connection.send(report)

    def _on_disconnect(self, connection: Connection, now: float) -> None:
        """Set the conditions of a connection that ended or was closed for a fault."""
        if not connection.fault.startswith(DISCONNECTED):
            self._refused_until = now + FAULT_HOLD_TIME
            self._log_operator(connection, f" closed: {connection.fault}")
        if connection is self._commander:
            self._commander = None
            if connection.fault == FLOOD:
                self._flood_until = now + FAULT_HOLD_TIME

    def _log_operator(self, connection: Connection, text: str) -> None:
        self._log.note(self.robot.read().stamp, "operator", f"{connection.role} {connection.number}{text}")

    # --- received messages --------------------------------------------------------------------------------------

    def _dispatch(self, connection: Connection, sequence: int, message: Message, now: float) -> None:
        match message:
            case Hello() if connection.role == "stranger":
                self._authenticate(connection, message, now)
            case OperatorCommand():
                self._apply_operator_command(connection, message)
            case Heartbeat() | SceneRequest() | Propose() | CheckRequest() | CountsRequest() if (
                connection.role == "stranger"
            ):
                connection.fault = f"{type(message).__name__} before authentication"
            case SceneRequest():
                connection.send(self._scene_report())
            case CountsRequest():
                connection.send(CountsReport(self._counter.counts(*self.robot.timing_faults())))
            case Propose():
                self._submit_contract(connection, sequence, message, now)
            case CheckRequest():
                self._check_contract(connection, sequence, message)
            case Heartbeat():
                pass
            case _:
                connection.fault = f"unexpected {type(message).__name__}"

    def _authenticate(self, connection: Connection, hello: Hello, now: float) -> None:
        """Assign a role; observers need no key, and the first commander keeps the role until disconnected or silent."""
        secret = self._keys.secrets.get(hello.principal)
        if hello.principal:
            if secret is None or not verify_hello_proof(secret, connection.nonce, hello.principal, hello.proof):
                connection.fault = (
                    "the proof of the principal is not valid: its key is not one of this gatekeeper. Name the key "
                    "folder with --keys (`dualbrain doctor` lists it)"
                )
                return
            if self.server.is_full:
                connection.fault = "there are too many connections"
                return
            connection.role = "operator" if hello.principal == OPERATOR else "commander"
        else:
            connection.role = "observer"
        if connection.role == "commander":
            if hello.principal not in self._capabilities:
                connection.fault = "no capability was granted to this principal"
                return
            if self._commander is not None and now - self._commander.last_received_at <= HEARTBEAT_TIMEOUT:
                connection.fault = (
                    "there is a commander already. Several agents share one through `dualbrain mcp --http`, and the "
                    "console of that server"
                )
                return
            if self._commander is not None:
                self._commander.fault = "silent, and another commander connected"
                self._commander_replaced = True
            self._commander, self._had_commander = connection, True
        connection.principal, connection.receives_reports = hello.principal, hello.watch
        registry = self._registry
        connection.send(
            Welcome(role=connection.role, now=self.robot.clock(), robot=registry.robot, registry=registry.hash)
        )

    def _apply_operator_command(self, connection: Connection, command: OperatorCommand) -> None:
        """Apply an operator command if the connection's role allows it, and log it."""
        if not is_allowed(command.act, connection.role):
            connection.send(RequestRefused(f"{command.act} needs the operator's key"))
            return
        reason = ""
        if command.act == "shut_down":
            self.shut_down()
        else:
            reason = self.operator_commands.apply(command)
        if reason:
            connection.send(RequestRefused(reason))
            return
        detail = f" {command.speed:.0%}" if command.act == "speed" else ""
        self._log_operator(connection, f": {command.act}{detail}")

    def _submit_contract(self, connection: Connection, sequence: int, message: Propose, now: float) -> None:
        """Check authentication, authority and rate, then pass the contract to the gate.

        A contract that is rejected here has not been parsed.
        """
        reason = self._rejection_reason(connection, sequence, message, now)
        if not reason:
            header = ContractHeader(
                sequence=(connection.number << 32) + sequence,
                issued=message.issued,
                expires=min(message.expires, message.issued + MAX_CONTRACT_LIFETIME),
                principal=connection.principal,
                scene_version=message.scene_version,
            )
            request = self._gate_request(connection, sequence, message.contract, header)
            if self._gate.busy:  # with a dry run, which must not reject a contract
                self._waiting_request = request
            else:
                self._gate.submit(request)
        if reason:
            self._refused_until = now + FAULT_HOLD_TIME
            self._counter.count_verdict("not_considered")
            self._log.note(self.robot.read().stamp, "verdict", f"not considered: {reason}")
            connection.send(RequestRefused(reason))

    def _check_contract(self, connection: Connection, sequence: int, message: CheckRequest) -> None:
        """Pass a contract to the gate for a verdict without consequences, also while another contract runs."""
        reason = ""
        if connection is not self._commander:
            reason = "only the commander may have contracts checked"
        elif self._gate.busy or self._waiting_request is not None:
            reason = "another contract is being checked; check it again in a moment"
        if reason:
            connection.send(CheckReport(sequence=sequence, refused=reason))
            return
        now = self.robot.clock()
        header = ContractHeader(
            sequence=sequence,
            issued=now,
            expires=now,
            principal=connection.principal,
            scene_version=self.loop.scene.version,
        )
        request = self._gate_request(connection, sequence, message.contract, header)
        self._dry_run = self._gate.submit(replace(request, dry_run=True))

    def _gate_request(
        self, connection: Connection, sequence: int, contract: bytes, header: ContractHeader
    ) -> GateRequest:
        """The request to check `contract` against the present state."""
        return GateRequest(
            connection_number=connection.number,
            sequence=sequence,
            contract=contract,
            stamp=header,
            now=self.robot.clock(),
            scene=self.loop.scene,
            state=self.loop.state,
            holding=self.loop.controller.holding,
        )

    def _rejection_reason(self, connection: Connection, sequence: int, message: Propose, now: float) -> str:
        """The reason why a contract is not passed to the gate; "" if it is."""
        if connection is not self._commander:
            return "only the commander may propose contracts"
        if not verify_contract_mac(self._keys.secrets[connection.principal], connection.nonce, sequence, message):
            connection.fault = "the contract's authentication code is not valid"
            return connection.fault
        if self.busy:
            return "busy: one contract at a time"
        if not self._within_rate_limit(connection.principal, now):
            return "too many contracts: the granted rate is used up"
        if self.robot.clock() >= self._capabilities[connection.principal].expires:
            return "the capability of this principal has expired"
        return ""

    def _within_rate_limit(self, principal: str, now: float) -> bool:
        """Take one contract out of a token bucket of `rate` contracts that fills within a minute."""
        rate = self._capabilities[principal].rate
        level, since = self._rate_buckets.get(principal, (rate, now))
        level = min(rate, level + (now - since) * rate / 60.0)
        fits = level >= 1.0
        self._rate_buckets[principal] = (level - 1.0 if fits else level, now)
        return fits

    def _apply_gate_reply(self, reply: GateReply) -> None:
        """Report a verdict; an accepted contract is next if its proposer is still the commander."""
        request, verdict = reply.request, reply.verdict
        proposer = next((one for one in self.server.connections if one.number == request.connection_number), None)
        rejected = None if isinstance(verdict, Accepted) else verdict
        if request.dry_run:
            if proposer is not None:
                proposer.send(CheckReport(sequence=request.sequence, rejected=rejected, gate_s=reply.seconds))
            self._submit_waiting_request()
            return
        self._counter.count_verdict("accepted" if rejected is None else f"rejected_{rejected.stage}")
        if proposer is not None:
            proposer.send(VerdictReport(sequence=request.sequence, rejected=rejected, gate_s=reply.seconds))
        if isinstance(verdict, Accepted) and proposer is self._commander and proposer is not None:
            self._next_contract, self._proposer = verdict.contract, proposer

    def _submit_waiting_request(self) -> None:
        """Pass the contract that waited for the end of a dry run to the gate, with the present state."""
        self._dry_run, request, self._waiting_request = False, self._waiting_request, None
        if request is not None:
            state, scene, holding = self.loop.state, self.loop.scene, self.loop.controller.holding
            self._gate.submit(replace(request, now=self.robot.clock(), scene=scene, state=state, holding=holding))

    # --- reports ------------------------------------------------------------------------------------------------

    def _scene_report(self) -> SceneReport:
        return SceneReport(
            now=self.robot.clock(),
            scene=self.loop.scene,
            q=tuple(self.loop.state.q.tolist()),
            opening=self.loop.state.opening,
            holding=self.loop.held_object,
        )

    def _broadcast_event(self, event: Event) -> None:
        data = {key: value for key, value in event.data.items() if isinstance(value, str | float | int | bool)}
        self.server.broadcast(EventReport(event.t, event.kind, event.text, data))

    def _broadcast_tick(self, snapshot: TickSnapshot) -> None:
        if not any(connection.receives_reports for connection in self.server.connections):
            return
        state, result = snapshot.state, snapshot.result
        self.server.broadcast(
            TickReport(
                t=state.stamp,
                scene=snapshot.scene,
                q=tuple(state.q.tolist()),
                opening=state.opening,
                u=tuple(result.u.tolist()),
                delta=result.delta,
                h_min=None if isnan(result.h_min) else result.h_min,
                status=result.status.name,
                barriers=result.barriers,
                skill=snapshot.skill,
                phase=snapshot.nominal.phase,
                in_contract=snapshot.action >= 0,
                order=snapshot.decision.action.name,
                check=snapshot.decision.check,
                u_nom=tuple(result.u_nom.tolist()),
                pairs=result.obstacle_pairs,
            )
        )
