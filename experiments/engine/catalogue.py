"""All experiments by name, in the order in which they are run."""

from __future__ import annotations

from benchmarks.guards.depth_obstacles import DepthObstacles
from benchmarks.guards.mocap_guard.experiment import MocapGuard
from benchmarks.guards.policy_guards import PolicyGuards
from experiments.adaptation.ablation_curve import AblationCurve
from experiments.adaptation.named_alternatives import NamedAlternatives
from experiments.adaptation.retention import Retention
from experiments.adaptation.rounds import Rounds
from experiments.adaptation.starter import Starter
from experiments.adaptation.suite_adapters import SuiteAdapters
from experiments.adaptation.twin_agreement import TwinAgreement
from experiments.engine.experiment import Experiment
from experiments.evaluation.clauses import Clauses
from experiments.evaluation.demo_sentence import DemoSentence
from experiments.evaluation.failure_examples import FailureExamples
from experiments.evaluation.free_instructions import FreeInstructionsExperiment
from experiments.evaluation.gentle_force import GentleForce
from experiments.evaluation.outcome_confusion import OutcomeConfusion
from experiments.evaluation.repeated_contracts import RepeatedContracts
from experiments.gatekeeper.adversary_over_mcp import AdversaryOverMcp
from experiments.gatekeeper.check_cost import CheckCost
from experiments.gatekeeper.commander_failure import CommanderFailure
from experiments.gatekeeper.faults import Faults
from experiments.gatekeeper.preempt_rt.missed_periods import PreemptRt
from experiments.gatekeeper.thread_timing.control_thread import ControlThreadTiming
from experiments.gatekeeper.tick import TickTiming
from experiments.interfaces.bad_input import BadInput
from experiments.interfaces.contract_delay import ContractDelay
from experiments.interfaces.fuzz_documents import FuzzDocuments
from experiments.interfaces.fuzz_observations import FuzzObservations
from experiments.interfaces.fuzz_socket import FuzzSocket
from experiments.interfaces.untrusted_bytes.bad_bytes import BadBytes
from experiments.memory.crash_recovery import CrashRecovery
from experiments.memory.learning import Learning
from experiments.memory.poisoning import Poisoning
from experiments.memory.shared_ledger import SharedLedger
from experiments.planning.documents import Documents
from experiments.planning.end_to_end import EndToEnd, FilterAblation
from experiments.planning.family_sweep import FamilySweep
from experiments.planning.language import Language
from experiments.planning.sensitivity_sweep import SensitivitySweep
from experiments.planning.site_documents import SiteDocuments
from experiments.robots.aloha.aloha_arms import AlohaArms
from experiments.robots.cross_embodiment import CrossEmbodiment
from experiments.robots.franka_limits import FrankaLimits
from experiments.robots.grasping import Grasping
from experiments.robots.robosuite_guard.experiment import RobosuiteGuard
from experiments.robots.robosuite_tasks import RobosuiteTasks
from experiments.robots.ros2.rates import Ros2Rates
from experiments.robots.so101.careless_servos import CarelessServos
from experiments.robots.targets.host_kills import HostKills
from experiments.robots.targets.target_bits import TargetBits
from experiments.robots.targets.target_faults import TargetFaults
from experiments.robots.zoo.robot_zoo import RobotZoo
from experiments.safety.adversary.forward_invariance import Adversary
from experiments.safety.conservatism import Conservatism
from experiments.safety.margin_causes import MarginCauses
from experiments.safety.no_obstacles import NoObstacles
from experiments.safety.plant_adversary import PlantAdversary
from experiments.safety.slow_tests import SlowTests
from experiments.safety.speed_limits.speed_limits import SpeedLimits

EXPERIMENTS: dict[str, Experiment] = {
    experiment.name: experiment
    for experiment in (
        Grasping(),
        NoObstacles(),
        SensitivitySweep(),
        FamilySweep(),
        EndToEnd(),
        FilterAblation(),
        Conservatism(),
        MarginCauses(),
        SlowTests(),
        BadInput(),
        BadBytes(),
        Adversary(),
        PlantAdversary(),
        SpeedLimits(),
        CrossEmbodiment(),
        RobotZoo(),
        TargetBits(),
        TargetFaults(),
        HostKills(),
        CrashRecovery(),
        SharedLedger(),
        Poisoning(),
        Learning(),
        Faults(),
        CommanderFailure(),
        AdversaryOverMcp(),
        CheckCost(),
        FuzzSocket(),
        FuzzObservations(),
        FuzzDocuments(),
        ContractDelay(),
        TickTiming(),
        ControlThreadTiming(),
        PreemptRt(),
        Language(),
        Documents(),
        SiteDocuments(),
        AblationCurve(),
        Retention(),
        Rounds(),
        SuiteAdapters(),
        TwinAgreement(),
        NamedAlternatives(),
        Starter(),
        RobosuiteTasks(),
        AlohaArms(),
        RobosuiteGuard(),
        MocapGuard(),
        PolicyGuards(),
        DepthObstacles(),
        Ros2Rates(),
        FrankaLimits(),
        CarelessServos(),
        FreeInstructionsExperiment(),
        FailureExamples(),
        Clauses(),
        GentleForce(),
        OutcomeConfusion(),
        RepeatedContracts(),
        DemoSentence(),
    )
}
"""`filter_ablation` follows `end_to_end`, whose contracts it carries out."""
