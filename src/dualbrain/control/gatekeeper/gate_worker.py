"""The gate worker: runs all three stages of the gate on its own thread, so that no control tick waits for them.

It checks the raw bytes of a contract against the scene, the joint state and the grasped object at the time of arrival,
with its own filter and controller. It has no access to the robot.
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
    """A contract to be checked, as received, with `stamp`, its header, and the robot's state and scene at arrival.

    `now` is the robot's time [s]; the reply goes to connection `connection_number` for its frame `sequence`.
    """

    connection_number: int
    sequence: int
    contract: bytes
    stamp: ContractHeader
    now: float
    scene: Scene
    state: RobotState
    holding: HeldObject | None


class GateReply(msgspec.Struct, frozen=True):
    """The gate's verdict on a request, and the time it took [s]."""

    request: GateRequest
    verdict: Verdict
    seconds: float


class GateWorker:
    """Takes one request at a time with `submit` and returns the reply with `take_reply`."""

    def __init__(
        self,
        robot_model: RobotModel,
        capabilities: Mapping[str, Capability],
        fixed_obstacles: tuple[Obstacle, ...] = (),
    ) -> None:
        """Start the thread, which ends with the process. `fixed_obstacles` are those of the site file."""
        self.registry = registry = skill_registry(robot_model)
        self._safety = SafetyFilter(robot_model, obstacles=fixed_obstacles)
        self._controller = make_controller(robot_model, self._safety)
        self._capabilities = dict(capabilities)
        self._gate = Gate(registry, skill_grants(capabilities), ())
        self._requests: Queue[GateRequest | None] = Queue(2)
        self._replies: Queue[GateReply] = Queue()
        self.busy = False
        self._thread = Thread(target=self._serve, name="gate worker", daemon=True)
        self._thread.start()

    def submit(self, request: GateRequest) -> bool:
        """Take a request; returns False while another one is being checked."""
        if self.busy:
            return False
        self.busy = True
        self._requests.put(request)
        return True

    def take_reply(self) -> GateReply | None:
        """The reply, or None while none is ready."""
        if not self.busy or self._replies.empty():
            return None
        self.busy = False
        return self._replies.get()

    def wait_until_idle(self) -> None:
        """Wait until the current request has been checked."""
        while self.busy and self._replies.empty() and self._thread.is_alive():
            time.sleep(1e-4)

    def close(self) -> None:
        """End the thread after the current request."""
        self._requests.put(None)
        self._thread.join(timeout=5.0)

    def _serve(self) -> None:
        while (request := self._requests.get()) is not None:
            start = time.monotonic()
            self._replies.put(GateReply(request, self.check(request), time.monotonic() - start))

    def check(self, request: GateRequest) -> Verdict:
        """The gate's verdict on `request`; a contract that makes the gate raise is rejected."""
        try:
            controller, principal = self._controller, request.stamp.principal
            controller.holding = request.holding
            controller.observe(
                Observation(
                    state=request.state, scene=request.scene, now=request.now, tool=self._safety.tool(request.state.q)
                )
            )
            capability = self._capabilities[principal]

            def check_envelope(contract: Contract) -> Rejected | None:
                rules = (capability.check_bounds, *scene_rules(request.scene, controller))
                return next((rejection for rule in rules if (rejection := rule(contract))), None)

            self._gate.rules = (check_envelope,)
            return self._gate.check(
                request.contract,
                names=scene_names(request.scene),
                principal=principal,
                now=request.now,
                header=request.stamp,
            )
        except Exception as error:  # a contract that cannot be checked is not accepted
            return Rejected(
                stage="envelope",
                pointer="",
                got=f"{type(error).__name__}: {error}"[:200],
                allowed="a verdict",
                hint="the gate failed",
            )
