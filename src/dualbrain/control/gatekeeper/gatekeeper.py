"""The gatekeeper: owns robot, skills, filter, supervisor and the control tick; everyone else asks.

In every tick it reads a little from the socket, hands contracts to its clerk, and gives what it finds to the supervisor
as conditions. A commander that dies, hangs, floods or talks rubbish is a condition like any other.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isnan

from dualbrain.contracts.contract import Contract, ContractHeader
from dualbrain.contracts.verdict import Accepted
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopInputs, LoopObserver, TickSnapshot
from dualbrain.control.gatekeeper.capability import Capability
from dualbrain.control.gatekeeper.gate_worker import GateReply, GateRequest, GateWorker
from dualbrain.control.gatekeeper.operator_commands import OperatorCommands, is_allowed
from dualbrain.control.gatekeeper.protocol.authentication import Keys, verify_contract_mac, verify_hello_proof
from dualbrain.control.gatekeeper.protocol.messages import (
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
from dualbrain.control.gatekeeper.protocol.server import Connection, SocketServer
from dualbrain.control.gatekeeper.robot_link.interface import RobotLink
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.records import Outcome
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.timing import Timing

OPERATOR = "operator"
HEARTBEAT_TIMEOUT = 0.3
"""A commander not heard for this long [s] has gone silent."""
AUTHENTICATION_TIMEOUT = 2.0
"""Whoever has not said who they are by then is let go [s]."""
FAULT_HOLD_TIME = 0.5
"""How long a flood, or a refused message, is held against the commander [s]."""
STATUS_PERIOD, CLEANUP_PERIOD = 0.05, 10.0
"""Time between heartbeats downward, and between clean-ups while idle [s]."""
TICK_REPORT_PERIOD = 0.066
"""Time between glimpses for people [s]."""
MAX_CONTRACT_LIFETIME = 660.0
"""A contract may not be meant to live longer than this [s]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GatekeeperSettings:
    """Settings of a gatekeeper that do not change while it runs.

    `timing`: limits on delays of the robot's interface. `speed_stage`: initial speed scale, (0, 1]. `fixed_obstacles`:
    obstacles of the site. `filter_config`: settings of the filter for this robot. `drive_initially_off`: the drive has
    to be switched on first.
    """

    timing: Timing
    speed_stage: float = 1.0
    fixed_obstacles: tuple[Obstacle, ...] = ()
    filter_config: FilterConfig | None = None
    drive_initially_off: bool = False


class Gatekeeper:
    """Owns one robot and one socket server, and accepts contracts from one commander at a time."""

    def __init__(
        self,
        robot_model: RobotModel,
        robot: RobotLink,
        server: SocketServer,
        keys: Keys,
        capabilities: Mapping[str, Capability],
        *,
        settings: GatekeeperSettings,
        recorder: Recorder | None = None,
        trace: Trace | None = None,
        monotonic: Callable[[], float] = time.monotonic,
        on_outcome: Callable[[Outcome], None] = lambda outcome: None,
        mark_part: Callable[[str], None] = lambda part: None,
    ) -> None:
        """Connect all parts; the robot holds position until a contract is accepted.

        Connections are timed by `monotonic` [s]. `on_outcome` gets every outcome, `mark_part` the name of the part of a
        tick that has just ended.
        """
        self.robot, self.server, self.operator_commands = robot, server, OperatorCommands(settings.speed_stage)
        self._keys, self._capabilities = keys, dict(capabilities)
        self._gate_worker = GateWorker(robot_model, capabilities, settings.fixed_obstacles)
        self._trace = Trace(robot_model.n) if trace is None else trace
        self._log = FlightLog(self._trace, recorder, self._broadcast_event)
        self._commander: Connection | None = None
        self._had_commander = False
        self._flood_until = self._refused_until = -1.0
        self._next_contract: Contract | None = None
        self._proposer: Connection | None = None
        self._shutdown_requested, self._busy, self._ticks = False, False, 0
        self._drive_initially_off = settings.drive_initially_off
        self._monotonic, self._on_outcome = monotonic, on_outcome
        self._rate_buckets: dict[str, tuple[float, float]] = {}
        self._robot_model = robot_model
        self._status_period_ticks, self._cleanup_period_ticks = (
            max(1, round(t / robot_model.period)) for t in (STATUS_PERIOD, CLEANUP_PERIOD)
        )
        self.loop = ControlLoop(
            robot_model,
            robot,
            robot,
            SafetyFilter(robot_model, settings.filter_config, obstacles=settings.fixed_obstacles),
            self._log,
            ControlLoopConfig(snapshot_period=TICK_REPORT_PERIOD, timing=settings.timing),
            LoopObserver(on_tick=self._broadcast_tick, on_phase=robot.set_phase, mark_part=mark_part),
            LoopInputs(external_conditions=self._service_connections, clock=robot.clock),
        )
        self.executor = ContractExecutor(self.loop)
        self.loop.safety_controller.speed_stage = settings.speed_stage

    def run(self) -> None:
        """Tick until told to shut down. No garbage is collected while a contract runs."""
        gc.collect()
        gc.freeze()
        gc.disable()
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
        self._gate_worker.close()
        gc.unfreeze()
        gc.enable()

    @property
    def busy(self) -> bool:
        """Whether a contract runs, is next, or is being judged."""
        return self._busy or self._next_contract is not None or self._gate_worker.busy

    def wait_for_gate_worker(self) -> None:
        """Wait for the clerk, where time stands still meanwhile: lockstep does not depend on the machine."""
        self._gate_worker.wait_until_idle()

    def shut_down(self) -> None:
        """End after this tick, or as soon as the contract that runs has been braked off."""
        self._shutdown_requested = True

    def _execute(self, contract: Contract) -> None:
        self._trace.clear()
        self._log.binding.clear()
        self.robot.start_contract(contract)
        self._busy = True
        outcome = self.executor.execute(contract)
        self._busy = False
        self._on_outcome(outcome)
        if self._proposer in self.server.connections and self._proposer:
            self._proposer.send(OutcomeReport(outcome, dict(self._log.binding)))

    # --- once a tick --------------------------------------------------------------------------------------------

    def _service_connections(self) -> int:
        """Hear, answer, and say which conditions hold; called by the local layer in every tick."""
        now = self._monotonic()
        self._ticks += 1
        for peer, sequence, message in self.server.receive(now):
            self._dispatch(peer, sequence, message, now)
        for peer in self.server.failed_connections():
            self._on_disconnect(peer, now)
        if (ruling := self._gate_worker.take_reply()) is not None:
            self._apply_gate_reply(ruling)
        if self._ticks % self._status_period_ticks == 0:
            self._send_status(now)
        self.loop.safety_controller.speed_stage = self.operator_commands.speed_stage
        return self._conditions(now)

    def _conditions(self, now: float) -> int:
        flags = self.operator_commands.conditions() | self.robot.conditions()
        if self._had_commander and self._commander is None:
            flags |= Condition.LINK_LOST
        elif self._commander is not None and now - self._commander.last_received_at > HEARTBEAT_TIMEOUT:
            flags |= Condition.HEARTBEAT_LOST
        if now < self._flood_until:
            flags |= Condition.FLOOD
        if now < self._refused_until:
            flags |= Condition.FRAMES_REFUSED
        return flags | (Condition.INTERRUPT if self._shutdown_requested and self._busy else 0)

    def _send_status(self, now: float) -> None:
        order = self.loop.safety_controller.decision
        beat = StatusReport(
            now=self.robot.clock(),
            action=order.action.name,
            cause=order.cause.value,
            check=order.check,
            busy=self.busy,
        )
        for peer in self.server.connections:
            if peer.role == "stranger" and now - peer.last_received_at > AUTHENTICATION_TIMEOUT:
                peer.fault = peer.fault or "nobody"
            elif peer.role != "stranger":
                peer.send(beat)

    def _on_disconnect(self, peer: Connection, now: float) -> None:
        """A peer is gone or was shut out."""
        if not peer.fault.startswith("gone"):
            self._refused_until = now + FAULT_HOLD_TIME
            self._log.note(self.robot.read().stamp, "operator", f"{peer.role} {peer.number} shut out: {peer.fault}")
        if peer is self._commander:
            self._commander = None
            if peer.fault == "flood":
                self._flood_until = now + FAULT_HOLD_TIME

    # --- what is said -------------------------------------------------------------------------------------------

    def _dispatch(self, peer: Connection, sequence: int, message: Message, now: float) -> None:
        match message:
            case Hello() if peer.role == "stranger":
                self._authenticate(peer, message, now)
            case OperatorCommand():
                self._apply_operator_command(peer, message)
            case Heartbeat() | SceneRequest() | Propose() if peer.role == "stranger":
                peer.fault = "speaks before it has said who it is"
            case SceneRequest():
                peer.send(self._scene_report())
            case Propose():
                self._submit_contract(peer, sequence, message, now)
            case Heartbeat():
                pass
            case _:
                peer.fault = f"{type(message).__name__} is out of place"

    def _authenticate(self, peer: Connection, hello: Hello, now: float) -> None:
        """Observers need no key; the first who proves to be a commander is it until gone or silent."""
        secret = self._keys.secrets.get(hello.principal)
        if hello.principal:
            if secret is None or not verify_hello_proof(secret, peer.nonce, hello.principal, hello.proof):
                peer.fault = "not who it says it is"
                return
            peer.role = "operator" if hello.principal == OPERATOR else "commander"
        else:
            peer.role = "observer"
        if peer.role == "commander":
            if hello.principal not in self._capabilities:
                peer.fault = "no capability was granted to this principal"
                return
            if self._commander is not None and now - self._commander.last_received_at <= HEARTBEAT_TIMEOUT:
                peer.fault = "there is a commander already"
                return
            if self._commander is not None:
                self._commander.fault = "silent, and another commander came"
            self._commander, self._had_commander = peer, True
        peer.principal, peer.receives_reports = hello.principal, hello.watch
        registry = self._gate_worker.registry
        peer.send(Welcome(role=peer.role, now=self.robot.clock(), robot=registry.robot, registry=registry.hash))

    def _apply_operator_command(self, peer: Connection, wish: OperatorCommand) -> None:
        """A person's hand, told in the log whoever it is."""
        if not is_allowed(wish.act, peer.role):
            peer.send(RequestRefused(f"{wish.act} needs the operator's key"))
            return
        why = ""
        if wish.act == "shut_down":
            self.shut_down()
        else:
            why = self.operator_commands.apply(wish)
        if why:
            peer.send(RequestRefused(why))
            return
        detail = f" {wish.speed:.0%}" if wish.act == "speed" else ""
        self._log.note(self.robot.read().stamp, "operator", f"{peer.role} {peer.number}: {wish.act}{detail}")

    def _submit_contract(self, peer: Connection, sequence: int, message: Propose, now: float) -> None:
        """Seal, right and rate; then the clerk. What is refused here has not been parsed at all."""
        why = self._refusal_reason(peer, sequence, message, now)
        if not why:
            state = self.loop.state
            moment = self.robot.clock()
            stamp = ContractHeader(
                sequence=(peer.number << 32) + sequence,
                issued=message.issued,
                expires=min(message.expires, message.issued + MAX_CONTRACT_LIFETIME),
                principal=peer.principal,
                scene_version=message.scene_version,
            )
            case = GateRequest(
                connection_number=peer.number,
                sequence=sequence,
                contract=message.contract,
                stamp=stamp,
                now=moment,
                scene=self.loop.scene,
                state=state,
                holding=self.loop.controller.holding,
            )
            why = "" if self._gate_worker.submit(case) else "another contract is being judged"
        if why:
            self._refused_until = now + FAULT_HOLD_TIME
            self._log.note(self.robot.read().stamp, "verdict", f"not considered: {why}")
            peer.send(RequestRefused(why))

    def _refusal_reason(self, peer: Connection, sequence: int, message: Propose, now: float) -> str:
        """Why a contract is not even looked at; "" if it is."""
        if peer is not self._commander:
            return "only the commander proposes"
        if not verify_contract_mac(self._keys.secrets[peer.principal], peer.nonce, sequence, message):
            peer.fault = "a seal that is not genuine"
            return peer.fault
        if self.busy:
            return "busy: one contract at a time"
        if not self._within_rate_limit(peer.principal, now):
            return "too many contracts: the granted rate is used up"
        if self.robot.clock() >= self._capabilities[peer.principal].expires:
            return "the capability of this principal has ended"
        return ""

    def _within_rate_limit(self, principal: str, now: float) -> bool:
        """A bucket of `rate` contracts that fills within a minute."""
        rate = self._capabilities[principal].rate
        level, since = self._rate_buckets.get(principal, (rate, now))
        level = min(rate, level + (now - since) * rate / 60.0)
        fits = level >= 1.0
        self._rate_buckets[principal] = (level - 1.0 if fits else level, now)
        return fits

    def _apply_gate_reply(self, ruling: GateReply) -> None:
        """A verdict is there: it is told, and an accepted contract is next, if the one who asked still commands."""
        case, verdict = ruling.request, ruling.verdict
        asker = next((peer for peer in self.server.connections if peer.number == case.connection_number), None)
        rejected = None if isinstance(verdict, Accepted) else verdict
        if asker is not None:
            asker.send(VerdictReport(sequence=case.sequence, rejected=rejected, gate_s=ruling.seconds))
        if isinstance(verdict, Accepted) and asker is self._commander and asker is not None:
            self._next_contract, self._proposer = verdict.contract, asker

    # --- what is told -------------------------------------------------------------------------------------------

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

    def _broadcast_tick(self, moment: TickSnapshot) -> None:
        if not any(peer.receives_reports for peer in self.server.connections):
            return
        state, result = moment.state, moment.result
        self.server.broadcast(
            TickReport(
                t=state.stamp,
                scene=moment.scene,
                q=tuple(state.q.tolist()),
                opening=state.opening,
                u=tuple(result.u.tolist()),
                delta=result.delta,
                h_min=None if isnan(result.h_min) else result.h_min,
                status=result.status.name,
                barriers=result.barriers,
                skill=moment.skill,
                phase=moment.nominal.phase,
                in_contract=moment.action >= 0,
                order=moment.order.action.name,
                check=moment.order.check,
            )
        )
