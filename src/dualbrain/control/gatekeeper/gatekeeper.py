"""The gatekeeper: owns robot, skills, filter, supervisor and the control tick; everyone else asks.

In every tick it reads a little from the socket, hands contracts to its clerk, and gives what it finds to the supervisor
as conditions. A commander that dies, hangs, floods or talks rubbish is a condition like any other.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from math import isnan

from dualbrain.contracts.contract import Contract, Stamp
from dualbrain.contracts.verdict import Accepted
from dualbrain.control.contract_executor import LocalLayer
from dualbrain.control.control_loop import LayerConfig, Moment
from dualbrain.control.gatekeeper.capability import Capability
from dualbrain.control.gatekeeper.gate_worker import Case, Clerk, Ruling
from dualbrain.control.gatekeeper.operator_commands import Hand, allowed
from dualbrain.control.gatekeeper.protocol.authentication import Keys, genuine, proven
from dualbrain.control.gatekeeper.protocol.messages import (
    Answer,
    Beat,
    Ended,
    Glimpse,
    Heartbeat,
    Hello,
    Look,
    Message,
    News,
    Operate,
    Propose,
    Refused,
    Sight,
    Welcome,
)
from dualbrain.control.gatekeeper.protocol.server import Door, Peer
from dualbrain.control.gatekeeper.robot_link.interface import Wired
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.recorder import Recorder
from dualbrain.control.recording.trace import Event, Trace
from dualbrain.records import Outcome
from dualbrain.robots.model import Body
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.supervisor.conditions import Condition
from dualbrain.safety.supervisor.timing import Timing

OPERATOR = "operator"
SILENCE = 0.3
"""A commander not heard for this long [s] has gone silent."""
NAMELESS = 2.0
"""Whoever has not said who they are by then is let go [s]."""
MEMORY = 0.5
"""How long a flood, or a refused message, is held against the commander [s]."""
BEAT_EVERY, TIDY_EVERY = 0.05, 10.0
"""Time between heartbeats downward, and between clean-ups while idle [s]."""
GLIMPSE_EVERY = 0.066
"""Time between glimpses for people [s]."""
LONGEST_LIFE = 660.0
"""A contract may not be meant to live longer than this [s]."""


class Gatekeeper:
    """One robot, one door, one commander at a time."""

    def __init__(
        self, body: Body, robot: Wired, door: Door, keys: Keys, capabilities: Mapping[str, Capability], *,
        timing: Timing, recorder: Recorder | None = None, trace: Trace | None = None, stage: float = 1.0,
        standing: tuple[Obstacle, ...] = (), config: FilterConfig | None = None, off_at_first: bool = False,
        monotonic: Callable[[], float] = time.monotonic, ended: Callable[[Outcome], None] = lambda outcome: None,
        lap: Callable[[str], None] = lambda part: None,
    ) -> None:  # fmt: skip
        """Bind everything; the robot stands still until a contract is accepted.

        `standing` is what a site says stands there for good; `config` are the filter's dials for this robot, and
        `off_at_first` says that its drive has to be switched on. Peers are timed by `monotonic` [s]; `ended` is told
        every outcome, `lap` what part of a tick has just been done.
        """
        self.robot, self.door, self.hand = robot, door, Hand(stage)
        self._keys, self._capabilities = keys, dict(capabilities)
        self._clerk = Clerk(body, capabilities, standing)
        self._trace = Trace(body.n) if trace is None else trace
        self._log = FlightLog(self._trace, recorder, self._announce)
        self._commander: Peer | None = None
        self._had_commander = False
        self._flood_until = self._refused_until = -1.0
        self._next: Contract | None = None
        self._asker: Peer | None = None
        self._quit, self._busy, self._ticks = False, False, 0
        self._off_at_first = off_at_first
        self._monotonic, self._ended = monotonic, ended
        self._tokens: dict[str, tuple[float, float]] = {}
        self._body = body
        self._beat_every, self._tidy_every = (max(1, round(t / body.period)) for t in (BEAT_EVERY, TIDY_EVERY))
        self.layer = LocalLayer(
            body, robot, robot, SafetyFilter(body, config, standing=standing), self._log,
            LayerConfig(watch_every=GLIMPSE_EVERY),
            watch=self._glimpse, phase_changed=robot.allow, clock=robot.clock, asked=self._service, timing=timing,
            lap=lap,
        )  # fmt: skip
        self.layer.spine.stage = stage

    def run(self) -> None:
        """Tick until told to shut down. No garbage is collected while a contract runs."""
        gc.collect()
        gc.freeze()
        gc.disable()
        if self._off_at_first:
            self.robot.enable()
            self.layer.spine.switched_on(self.layer.state, self.robot.clock())
        while not self._quit:
            contract, self._next = self._next, None
            if contract is not None:
                self._carry_out(contract)
            else:
                self.layer.hold(self._body.period, "idle")
                if self._ticks % self._tidy_every == 0:
                    self._trace.forget()
                    gc.collect(0)
        self._clerk.close()
        gc.unfreeze()
        gc.enable()

    @property
    def busy(self) -> bool:
        """Whether a contract runs, is next, or is being judged."""
        return self._busy or self._next is not None or self._clerk.busy

    def settle(self) -> None:
        """Wait for the clerk, where time stands still meanwhile: lockstep does not depend on the machine."""
        self._clerk.settle()

    def shut_down(self) -> None:
        """End after this tick, or as soon as the contract that runs has been braked off."""
        self._quit = True

    def _carry_out(self, contract: Contract) -> None:
        self._trace.forget()
        self._log.binding.clear()
        self.robot.begin(contract)
        self._busy = True
        outcome = self.layer.run(contract)
        self._busy = False
        self._ended(outcome)
        if self._asker in self.door.peers and self._asker:
            self._asker.say(Ended(outcome, dict(self._log.binding)))

    # --- once a tick --------------------------------------------------------------------------------------------

    def _service(self) -> int:
        """Hear, answer, and say which conditions hold; called by the local layer in every tick."""
        now = self._monotonic()
        self._ticks += 1
        for peer, sequence, message in self.door.hear(now):
            self._take(peer, sequence, message, now)
        for peer in self.door.faulty():
            self._lose(peer, now)
        if (ruling := self._clerk.ruling()) is not None:
            self._rule(ruling)
        if self._ticks % self._beat_every == 0:
            self._beat(now)
        self.layer.spine.stage = self.hand.stage
        return self._conditions(now)

    def _conditions(self, now: float) -> int:
        flags = self.hand.conditions() | self.robot.flags()
        if self._had_commander and self._commander is None:
            flags |= Condition.LINK_LOST
        elif self._commander is not None and now - self._commander.heard > SILENCE:
            flags |= Condition.HEARTBEAT_LOST
        if now < self._flood_until:
            flags |= Condition.FLOOD
        if now < self._refused_until:
            flags |= Condition.FRAMES_REFUSED
        return flags | (Condition.INTERRUPT if self._quit and self._busy else 0)

    def _beat(self, now: float) -> None:
        order = self.layer.spine.order
        beat = Beat(
            now=self.robot.clock(), action=order.action.name, cause=order.cause.value, check=order.check,
            busy=self.busy,
        )  # fmt: skip
        for peer in self.door.peers:
            if peer.role == "stranger" and now - peer.heard > NAMELESS:
                peer.fault = peer.fault or "nobody"
            elif peer.role != "stranger":
                peer.say(beat)

    def _lose(self, peer: Peer, now: float) -> None:
        """A peer is gone or was shut out."""
        if not peer.fault.startswith("gone"):
            self._refused_until = now + MEMORY
            self._log.note(self.robot.read().stamp, "operator", f"{peer.role} {peer.number} shut out: {peer.fault}")
        if peer is self._commander:
            self._commander = None
            if peer.fault == "flood":
                self._flood_until = now + MEMORY

    # --- what is said -------------------------------------------------------------------------------------------

    def _take(self, peer: Peer, sequence: int, message: Message, now: float) -> None:
        match message:
            case Hello() if peer.role == "stranger":
                self._welcome(peer, message, now)
            case Operate():
                self._operate(peer, message)
            case Heartbeat() | Look() | Propose() if peer.role == "stranger":
                peer.fault = "speaks before it has said who it is"
            case Look():
                peer.say(self._sight())
            case Propose():
                self._consider(peer, sequence, message, now)
            case Heartbeat():
                pass
            case _:
                peer.fault = f"{type(message).__name__} is out of place"

    def _welcome(self, peer: Peer, hello: Hello, now: float) -> None:
        """Observers need no key; the first who proves to be a commander is it until gone or silent."""
        secret = self._keys.secrets.get(hello.principal)
        if hello.principal:
            if secret is None or not proven(secret, peer.nonce, hello.principal, hello.proof):
                peer.fault = "not who it says it is"
                return
            peer.role = "operator" if hello.principal == OPERATOR else "commander"
        else:
            peer.role = "observer"
        if peer.role == "commander":
            if hello.principal not in self._capabilities:
                peer.fault = "no capability was granted to this principal"
                return
            if self._commander is not None and now - self._commander.heard <= SILENCE:
                peer.fault = "there is a commander already"
                return
            if self._commander is not None:
                self._commander.fault = "silent, and another commander came"
            self._commander, self._had_commander = peer, True
        peer.principal, peer.watches = hello.principal, hello.watch
        registry = self._clerk.registry
        peer.say(Welcome(role=peer.role, now=self.robot.clock(), robot=registry.robot, registry=registry.hash))

    def _operate(self, peer: Peer, wish: Operate) -> None:
        """A person's hand, told in the log whoever it is."""
        if not allowed(wish.act, peer.role):
            peer.say(Refused(f"{wish.act} needs the operator's key"))
            return
        why = ""
        if wish.act == "shut_down":
            self.shut_down()
        else:
            why = self.hand.act(wish)
        if why:
            peer.say(Refused(why))
            return
        detail = f" {wish.speed:.0%}" if wish.act == "speed" else ""
        self._log.note(self.robot.read().stamp, "operator", f"{peer.role} {peer.number}: {wish.act}{detail}")

    def _consider(self, peer: Peer, sequence: int, message: Propose, now: float) -> None:
        """Seal, right and rate; then the clerk. What is refused here has not been parsed at all."""
        why = self._unfit(peer, sequence, message, now)
        if not why:
            state = self.layer.state
            moment = self.robot.clock()
            stamp = Stamp(
                (peer.number << 32) + sequence, message.issued, min(message.expires, message.issued + LONGEST_LIFE),
                peer.principal, message.scene_version,
            )  # fmt: skip
            case = Case(
                peer.number, sequence, message.contract, stamp, moment, self.layer.scene, state, self.layer.limb.holding
            )
            why = "" if self._clerk.submit(case) else "another contract is being judged"
        if why:
            self._refused_until = now + MEMORY
            self._log.note(self.robot.read().stamp, "verdict", f"not considered: {why}")
            peer.say(Refused(why))

    def _unfit(self, peer: Peer, sequence: int, message: Propose, now: float) -> str:
        """Why a contract is not even looked at; "" if it is."""
        if peer is not self._commander:
            return "only the commander proposes"
        if not genuine(self._keys.secrets[peer.principal], peer.nonce, sequence, message):
            peer.fault = "a seal that is not genuine"
            return peer.fault
        if self.busy:
            return "busy: one contract at a time"
        if not self._afford(peer.principal, now):
            return "too many contracts: the granted rate is used up"
        if self.robot.clock() >= self._capabilities[peer.principal].expires:
            return "the capability of this principal has ended"
        return ""

    def _afford(self, principal: str, now: float) -> bool:
        """A bucket of `rate` contracts that fills within a minute."""
        rate = self._capabilities[principal].rate
        level, since = self._tokens.get(principal, (rate, now))
        level = min(rate, level + (now - since) * rate / 60.0)
        fits = level >= 1.0
        self._tokens[principal] = (level - 1.0 if fits else level, now)
        return fits

    def _rule(self, ruling: Ruling) -> None:
        """A verdict is there: it is told, and an accepted contract is next, if the one who asked still commands."""
        case, verdict = ruling.case, ruling.verdict
        asker = next((peer for peer in self.door.peers if peer.number == case.peer), None)
        rejected = None if isinstance(verdict, Accepted) else verdict
        if asker is not None:
            asker.say(Answer(sequence=case.sequence, rejected=rejected, gate_s=ruling.seconds))
        if isinstance(verdict, Accepted) and asker is self._commander and asker is not None:
            self._next, self._asker = verdict.contract, asker

    # --- what is told -------------------------------------------------------------------------------------------

    def _sight(self) -> Sight:
        layer = self.layer
        holding = layer.limb.holding
        return Sight(
            now=self.robot.clock(), scene=layer.scene, q=tuple(layer.state.q.tolist()), opening=layer.state.opening,
            holding=holding.name if holding else None,
        )  # fmt: skip

    def _announce(self, event: Event) -> None:
        data = {key: value for key, value in event.data.items() if isinstance(value, str | float | int | bool)}
        self.door.tell(News(event.t, event.kind, event.text, data))

    def _glimpse(self, moment: Moment) -> None:
        if not any(peer.watches for peer in self.door.peers):
            return
        state, result = moment.state, moment.result
        self.door.tell(
            Glimpse(
                t=state.stamp, scene=moment.scene, q=tuple(state.q.tolist()), opening=state.opening,
                u=tuple(result.u.tolist()), delta=result.delta,
                h_min=None if isnan(result.h_min) else result.h_min, status=result.status.name,
                barriers=result.barriers, skill=moment.skill, phase=moment.nominal.phase,
                in_contract=moment.action >= 0, order=moment.order.action.name, check=moment.order.check,
            )
        )  # fmt: skip
