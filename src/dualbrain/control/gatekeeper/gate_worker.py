"""The clerk: all three stages of the gate, on a thread of its own with a limb of its own, so that no tick waits for it.

It judges what it is handed (raw bytes, and the scene, posture and grip of that moment) and never touches the robot.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from queue import Queue
from threading import Thread

import msgspec

from dualbrain.contracts.contract import Contract, ContractHeader
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Rejected, Verdict
from dualbrain.control.gatekeeper.capability import Capability, skill_grants
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.records import Scene
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.skills.registry import make_controller, skill_registry
from dualbrain.skills.skill import HeldObject, Observation


class GateRequest(msgspec.Struct, frozen=True, kw_only=True):
    """A contract to be judged, as it came, and what the robot was like when it came."""

    connection_number: int
    sequence: int
    contract: bytes
    stamp: ContractHeader
    now: float
    scene: Scene
    state: RobotState
    holding: HeldObject | None


class GateReply(msgspec.Struct, frozen=True):
    """What the gate says of a case, and how long it took [s]."""

    request: GateRequest
    verdict: Verdict
    seconds: float


class GateWorker:
    """Hand cases in with `submit`, take rulings out with `ruling`; at most one case at a time."""

    def __init__(
        self,
        robot_model: RobotModel,
        capabilities: Mapping[str, Capability],
        fixed_obstacles: tuple[Obstacle, ...] = (),
    ) -> None:
        """Open the gate; the thread ends with the process. `standing` is what a site says stands there for good."""
        self.registry = registry = skill_registry(robot_model)
        self._safety = SafetyFilter(robot_model, obstacles=fixed_obstacles)
        self._controller = make_controller(robot_model, self._safety)
        self._capabilities = dict(capabilities)
        self._gate = Gate(registry, skill_grants(capabilities), ())
        self._requests: Queue[GateRequest | None] = Queue(2)
        self._replies: Queue[GateReply] = Queue()
        self.busy = False
        self._thread = Thread(target=self._serve, name="clerk", daemon=True)
        self._thread.start()

    def submit(self, request: GateRequest) -> bool:
        """Take a case; False while there is another."""
        if self.busy:
            return False
        self.busy = True
        self._requests.put(request)
        return True

    def take_reply(self) -> GateReply | None:
        """The ruling that is ready, if one is."""
        if not self.busy or self._replies.empty():
            return None
        self.busy = False
        return self._replies.get()

    def wait_until_idle(self) -> None:
        """Wait until the case that it has is judged."""
        while self.busy and self._replies.empty() and self._thread.is_alive():
            time.sleep(1e-4)

    def close(self) -> None:
        """End the thread once it has judged what it has."""
        self._requests.put(None)
        self._thread.join(timeout=5.0)

    def _serve(self) -> None:
        while (case := self._requests.get()) is not None:
            start = time.monotonic()
            self._replies.put(GateReply(case, self.check(case), time.monotonic() - start))

    def check(self, request: GateRequest) -> Verdict:
        """The gate's word on `case`; what makes the gate raise is refused."""
        try:
            limb, principal = self._controller, request.stamp.principal
            limb.holding = request.holding
            limb.observe(
                Observation(
                    state=request.state, scene=request.scene, now=request.now, tool=self._safety.tool(request.state.q)
                )
            )
            capability = self._capabilities[principal]

            def against_scene(contract: Contract) -> Rejected | None:
                rules = (capability.check_bounds, *scene_rules(request.scene, limb))
                return next((refusal for rule in rules if (refusal := rule(contract))), None)

            self._gate.rules = (against_scene,)
            return self._gate.check(
                request.contract,
                names=scene_names(request.scene),
                principal=principal,
                now=request.now,
                header=request.stamp,
            )
        except Exception as error:  # what cannot be judged is not accepted
            return Rejected(
                stage="envelope",
                pointer="",
                got=f"{type(error).__name__}: {error}"[:200],
                allowed="a verdict",
                hint="the gate failed",
            )
