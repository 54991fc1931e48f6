"""The clerk: all three stages of the gate, on a thread of its own with a limb of its own, so that no tick waits for it.

It judges what it is handed (raw bytes, and the scene, posture and grip of that moment) and never touches the robot.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from queue import Queue
from threading import Thread

import msgspec

from dualbrain.contracts.contract import Contract, Stamp
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Rejected, Verdict
from dualbrain.control.gatekeeper.capability import Capability, granted
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.records import Scene
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import Body
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.skills.registry import limb_of, registry_of
from dualbrain.skills.skill import Holding, Senses


class Case(msgspec.Struct, frozen=True):
    """A contract to be judged, as it came, and what the robot was like when it came."""

    peer: int
    sequence: int
    contract: bytes
    stamp: Stamp
    now: float
    scene: Scene
    state: RobotState
    holding: Holding | None


class Ruling(msgspec.Struct, frozen=True):
    """What the gate says of a case, and how long it took [s]."""

    case: Case
    verdict: Verdict
    seconds: float


class Clerk:
    """Hand cases in with `submit`, take rulings out with `ruling`; at most one case at a time."""

    def __init__(self, body: Body, capabilities: Mapping[str, Capability], standing: tuple[Obstacle, ...] = ()) -> None:
        """Open the gate; the thread ends with the process. `standing` is what a site says stands there for good."""
        self.registry = registry = registry_of(body)
        self._safety = SafetyFilter(body, standing=standing)
        self._limb = limb_of(body, self._safety)
        self._capabilities = dict(capabilities)
        self._gate = Gate(registry, granted(capabilities), ())
        self._cases: Queue[Case | None] = Queue(2)
        self._rulings: Queue[Ruling] = Queue()
        self.busy = False
        self._thread = Thread(target=self._work, name="clerk", daemon=True)
        self._thread.start()

    def submit(self, case: Case) -> bool:
        """Take a case; False while there is another."""
        if self.busy:
            return False
        self.busy = True
        self._cases.put(case)
        return True

    def ruling(self) -> Ruling | None:
        """The ruling that is ready, if one is."""
        if not self.busy or self._rulings.empty():
            return None
        self.busy = False
        return self._rulings.get()

    def settle(self) -> None:
        """Wait until the case that it has is judged."""
        while self.busy and self._rulings.empty() and self._thread.is_alive():
            time.sleep(1e-4)

    def close(self) -> None:
        """End the thread once it has judged what it has."""
        self._cases.put(None)
        self._thread.join(timeout=5.0)

    def _work(self) -> None:
        while (case := self._cases.get()) is not None:
            start = time.monotonic()
            self._rulings.put(Ruling(case, self.judge(case), time.monotonic() - start))

    def judge(self, case: Case) -> Verdict:
        """The gate's word on `case`; what makes the gate raise is refused."""
        try:
            limb, principal = self._limb, case.stamp.principal
            limb.holding = case.holding
            limb.sense(Senses(case.state, case.scene, case.now, self._safety.tool(case.state.q)))
            capability = self._capabilities[principal]

            def against_scene(contract: Contract) -> Rejected | None:
                rules = (capability.refusal, *scene_rules(case.scene, limb))
                return next((refusal for rule in rules if (refusal := rule(contract))), None)

            self._gate.rules = (against_scene,)
            return self._gate.check(
                case.contract, names=scene_names(case.scene), principal=principal, now=case.now, stamp=case.stamp
            )
        except Exception as error:  # what cannot be judged is not accepted
            return Rejected("envelope", "", f"{type(error).__name__}: {error}"[:200], "a verdict", "the gate failed")
