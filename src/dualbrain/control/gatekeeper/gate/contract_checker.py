"""Runs all three stages of the gate on the raw bytes of a contract, against the state of the robot at its arrival."""

from __future__ import annotations

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Rejected, Verdict
from dualbrain.control.gatekeeper.capability import skill_grants
from dualbrain.control.gatekeeper.gate.exchange import GateRequest, GateSetup, gate_failure
from dualbrain.grounding.envelope.scene_rules import scene_rules
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.skills.registry import make_controller, skill_registry
from dualbrain.skills.skill import Observation


class ContractChecker:
    """Checks contracts with a filter and a controller of its own; it has no access to the robot."""

    def __init__(self, setup: GateSetup) -> None:
        """Prepare the gate of the robot in `setup`."""
        self._safety = SafetyFilter(setup.robot_model, obstacles=setup.fixed_obstacles)
        self._controller = make_controller(setup.robot_model, self._safety)
        self._capabilities = dict(setup.capabilities)
        self._gate = Gate(skill_registry(setup.robot_model), skill_grants(setup.capabilities), ())

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
                header=None if request.dry_run else request.stamp,
            )
        except Exception as error:  # a contract that cannot be checked is not accepted
            return gate_failure(f"{type(error).__name__}: {error}")
