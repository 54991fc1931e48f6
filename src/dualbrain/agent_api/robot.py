"""A robot for an agent: it perceives, checks contracts, executes those that the gate accepts, and stops."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from threading import Lock
from types import TracebackType
from typing import Any, Self

import msgspec

from dualbrain.agent_api.connection import Connection, SimulationOptions, connect, start_simulation
from dualbrain.agent_api.event_feed import EventFeed
from dualbrain.agent_api.executions import DEFAULT_CLIENT, Executions
from dualbrain.agent_api.retries import RetryLog
from dualbrain.agent_api.stop_confirmation import confirm_stop, find_emergency_status
from dualbrain.agent_api.submission import SubmissionReport
from dualbrain.agent_api.tools import ToolForm, call_tool, export_tools, report_view, robot_tools
from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.strict_json import MAX_BYTES, parse
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.schema import ORDER_KEYWORD, decoding_schema, describe_skills, validation_schema
from dualbrain.contracts.verdict import Accepted, Rejected, Verdict
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError
from dualbrain.control.gatekeeper.protocol.emergency_stop import send_emergency_stop
from dualbrain.control.gatekeeper.protocol.messages import EventReport, Message, SceneReport, StatusReport
from dualbrain.core.paths import dualbrain_home
from dualbrain.errors import ConfigurationError
from dualbrain.grounding.envelope.grasp_fit import parameter_domains
from dualbrain.grounding.envelope.object_limits import describe_limits
from dualbrain.grounding.envelope.scene_rules import skill_order
from dualbrain.grounding.instruction.stop_commands import asks_to_stop, is_stop_command
from dualbrain.grounding.scene_summary import summarise_scene
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.planner.protocol import Planner
from dualbrain.skills.registry import skill_registry

RETRY_FOLDER = "submissions"
"""Folder of the data folder with one file per running gatekeeper: the contracts that were submitted to it."""
Json = bytes | str | dict[str, Any]
"""A contract as JSON text, which is checked and executed byte for byte, or as an object, which is encoded once."""


class Robot:
    """One robot behind a gatekeeper, with the rights of a commander: it can propose, abort and stop.

    `Robot.simulated` starts a gatekeeper with a simulated robot in real time; `Robot.connect` commands one that runs.
    Every contract passes the gatekeeper's own gate, and every motion its safety filter. An emergency stop can be sent
    but not released: a person does that with `dualbrain operate`. All methods may be called from any thread.
    """

    def __init__(
        self,
        open_connection: Callable[[Callable[[Message], None], ExitStack], Connection],
        *,
        planner: str | Planner | None,
        ledger: Path | None,
        runs: Path | None,
        retries: Path | None,
    ) -> None:
        """Use `Robot.simulated` or `Robot.connect`."""
        self._stack, self._feed, self._closing = ExitStack(), EventFeed(), Lock()
        try:
            self._connection = open_connection(self._receive, self._stack)
            known = RetryLog(retries, now=time.time())
            self._executions = Executions(
                self._connection, self._feed, known, planner=planner, ledger=ledger, runs=runs
            )
            self._stack.callback(self._executions.close)
        except BaseException:
            self.close()
            raise

    @classmethod
    def simulated(
        cls,
        robot: str = "panda",
        scene: str | int = "0",
        *,
        seed: int = 0,
        speed: float = 1.0,
        site: Path | None = None,
        recording: Path | None = None,
        report: Path | None = None,
        planner: str | Planner | None = None,
        ledger: Path | None = None,
        runs: Path | None = None,
    ) -> Self:
        """A simulated `robot` in a `scene` (number, FAMILY:SEED or file), in real time behind a gatekeeper process.

        `speed` is the speed scale, (0, 1]. `recording` is an MCAP file for every tick, `report` a file for the ground
        truth at the end. With a `planner` (a name as for `dualbrain run --planner`, or an object), `do` plans
        instructions. With a `ledger`, the episodes become memories under the name of their client; with a folder
        `runs`, each episode is saved in it with its report.

        Raises `ConfigurationError`, `UnknownNameError` and `MissingDependencyError`.
        """
        options = SimulationOptions(
            robot=robot, scene=str(scene), seed=seed, speed=speed, site=site, recording=recording, report=report
        )
        return cls(
            lambda receive, stack: start_simulation(options, receive, "an agent's `Robot.simulated`", stack),
            planner=planner,
            ledger=ledger,
            runs=runs,
            retries=None,
        )

    @classmethod
    def connect(
        cls,
        socket: Path | None = None,
        keys: Path | None = None,
        *,
        robot: str = "",
        site: Path | None = None,
        planner: str | Planner | None = None,
        ledger: Path | None = None,
        runs: Path | None = None,
    ) -> Self:
        """The robot of the gatekeeper that listens at `socket`; `keys` is the folder with `planner.key`.

        By default both are in the data folder, as for `dualbrain gatekeeper`. `robot` is needed for an imported robot
        (its folder), `site` for a gatekeeper with a site file. Otherwise as `Robot.simulated`.

        Raises `ConfigurationError`, and `ConnectionLostError` if the robot has a commander already.
        """
        where = Path(socket or dualbrain_home() / "gatekeeper.sock")
        secrets = Path(keys or dualbrain_home() / "keys")
        return cls(
            lambda receive, stack: connect(where, secrets, robot, site, receive, stack),
            planner=planner,
            ledger=ledger,
            runs=runs,
            retries=_retry_file(where),
        )

    # --- perception -------------------------------------------------------------------------------------------------

    @property
    def name(self) -> str:
        """Name of the robot."""
        return self._connection.robot_model.name

    @property
    def registry(self) -> SkillRegistry:
        """The skills of the robot, with their units and bounds."""
        return skill_registry(self._connection.robot_model)

    @property
    def gatekeeper_process_id(self) -> int:
        """The process of the gatekeeper, 0 if it was running before."""
        process = self._connection.process
        return process.process.pid if process else 0

    @property
    def has_planner(self) -> bool:
        """Whether `do` can plan instructions."""
        return self._executions.has_planner

    def scene(self) -> dict[str, Any]:
        """The perceived scene: a summary in symbols, the names that contracts may use, the skills, and a free id.

        `limits` are those of the site for named objects, in words; the entry is left out without any. Raises
        `ConnectionLostError`.
        """
        report = self._scene_report()
        names, registry = scene_names(report.scene), self.registry
        limits = {obj.name: describe_limits(obj.limits) for obj in report.scene.objects if obj.limits is not None}
        return {
            "summary": summarise_scene(report.scene, report.holding),
            "graspable": list(names.graspable),
            "receptive": list(names.receptive),
            "holding": report.holding,
            "robot": registry.robot,
            "registry": registry.hash,
            "next_id": self._executions.next_id(),
            "skills": describe_skills(registry, names),
            **({"limits": limits} if limits else {}),
        }

    def schema(self, form: str = "decoding") -> dict[str, Any]:
        """JSON Schema of a contract in the present scene.

        `decoding` is for generation: it leaves out the first actions that the robot's state refuses, and grasps that do
        not fit the object. `tool` is the same for any state, for the definition of a tool that a client keeps while
        the robot moves. `validation` is the whole Draft-07 schema with units and provenance. Raises
        `ConfigurationError` for another form.
        """
        registry, report = self.registry, self._scene_report()
        names = scene_names(report.scene)
        match form:
            case "validation":
                return validation_schema(registry, names)
            case "tool":
                return decoding_schema(registry, names)
            case "decoding":
                order = skill_order([skill.name for skill in registry.skills], report.holding)
                domains = parameter_domains(report.scene, registry, report.holding)
                schema = decoding_schema(registry, names, order=order, domains=domains)
                del schema["properties"]["action_sequence"][ORDER_KEYWORD]  # frameworks refuse unknown keywords
                return schema
            case _:
                raise ConfigurationError("form of the schema", got=form, allowed="decoding, tool or validation")

    def events(self, after: int = 0) -> list[dict[str, Any]]:
        """Events after the one with the number `after`: number, the robot's time t [s], kind, and text for people."""
        return self._feed.after(after)

    def status(self) -> StatusReport | None:
        """The gatekeeper's newest status report; None before the first one."""
        return self._connection.client.status

    # --- contracts --------------------------------------------------------------------------------------------------

    def contract(self, actions: list[dict[str, Any]], contract_id: str = "") -> dict[str, Any]:
        """A contract for this robot with `actions`, each {"skill": NAME, "params": {...}}, and by default a free id."""
        registry = self.registry
        context = {"robot": registry.robot, "registry": registry.hash}
        return {"id": contract_id or self._executions.next_id(), "context": context, "action_sequence": actions}

    def check(self, contract: Json) -> Verdict:
        """The verdict of the gatekeeper's own gate on a contract in the present scene; nothing moves.

        Raises `ConnectionLostError`, and `ContractNotCheckedError` while the gate checks another contract.
        """
        data = contract_bytes(contract)
        if len(data) > MAX_BYTES:
            rejected = parse(data)
            assert isinstance(rejected, Rejected)
            return rejected
        report = self._connection.client.check(data)
        return report.rejected or Accepted(msgspec.json.decode(data, type=Contract))

    def submit(self, contract: Json, instruction: str = "", *, client: str = DEFAULT_CLIENT) -> SubmissionReport:
        """Submit a contract, and wait for the gate's verdict; an accepted contract moves the robot.

        `instruction` is the sentence that it is to fulfil, for the record and the memory; `client` is its author. A
        contract that is submitted again within 15 minutes gets the report of the first submission. It is rejected
        while another one runs, and if its instruction is a stop command or asks for harm.
        """
        return self._executions.submit(contract_bytes(contract), instruction, client)

    def run(
        self,
        contract: Json,
        instruction: str = "",
        *,
        client: str = DEFAULT_CLIENT,
        timeout: float | None = None,
    ) -> SubmissionReport:
        """As `submit`, and wait for the outcome, at most `timeout` [s]; after a timeout the robot goes on."""
        report = self.submit(contract, instruction, client=client)
        if report.state == "rejected":
            return report
        ended = self._executions.wait(report.id, timeout) or report
        return msgspec.structs.replace(ended, repeated=report.repeated)

    def do(self, instruction: str, *, timeout: float | None = None) -> SubmissionReport:
        """Plan an instruction with the robot's own planner and memory, execute the contract, and wait for the outcome.

        After `timeout` [s] the report shows how far it is, and the robot goes on. While a contract runs, the
        instruction is rejected, unless it asks to stop; a stop command stops the robot in any case, as `stop`. The
        report of a stop is that of the contract that it ended. Raises `ConfigurationError` if there is no planner, and
        for a stop `ConnectionLostError`.
        """
        running = self._executions.in_progress
        if is_stop_command(instruction) or (running and asks_to_stop(instruction)):
            self.stop()  # also without a submission in progress: one that was lost may still move the robot
            if running and (ended := self._executions.wait(running, timeout)):
                return ended
        report = self._executions.plan_and_run(instruction)
        return self._executions.wait(report.id, timeout) or report

    def outcome(self, submission_id: str = "", *, timeout: float = 0.0) -> SubmissionReport | None:
        """The report on a contract or instruction by its id, by default the newest; None for an unknown id.

        With a `timeout` [s], the report follows when the contract has ended, or when this time is over.
        """
        return self._executions.wait(submission_id, timeout)

    def recent(self) -> list[dict[str, Any]]:
        """The newest contracts and instructions with their states and outcomes, the newest first."""
        return [report_view(report) for report in self._executions.recent()]

    def stop(self, *, emergency: bool = False) -> StatusReport | None:
        """Brake to rest and end the contract; with `emergency`, switch the drive off. Returns the status afterwards.

        The status is from after the stop, and shows it; None if only the connection of the emergency stop reports it.
        Raises `ConnectionLostError` if the stop cannot be sent or is not confirmed within 1 s.
        """
        try:
            self._send_stop(emergency=emergency)
        finally:
            self._executions.interrupt()  # after the stop, which waits for nothing
        client = self._connection.client
        return find_emergency_status(client) if emergency else confirm_stop(client)

    # --- tools ------------------------------------------------------------------------------------------------------

    def tools(self, form: ToolForm = "openai") -> list[dict[str, Any]]:
        """Definitions of the robot's tools for an agent framework: openai, anthropic or mcp.

        The schema of a contract holds the names in the present scene. Raises `ConnectionLostError` and `ToolError`.
        """
        return export_tools(robot_tools(self), form)

    def call(
        self, name: str, arguments: bytes | str | dict[str, Any] = b"{}", *, client: str = DEFAULT_CLIENT
    ) -> dict[str, Any]:
        """The result of a tool call of a model, as JSON data; {"error": ...} for a call that is not valid.

        `arguments` is the JSON text that the model wrote, or the decoded object.
        """
        return call_tool(self, name, arguments, client=client)

    # --- life -------------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Disconnect, and end a gatekeeper that was started here; its robot brakes to rest first.

        A contract that runs is stopped, and its episode is completed. A second call waits for the first.
        """
        with self._closing:
            self._stack.close()

    def begin_close(self) -> None:
        """Begin what `close` completes, without waiting: accept no contract any more, and brake to rest."""
        self._executions.begin_close()
        if (process := self._connection.process) is not None:
            process.request_stop()

    def kill(self) -> None:
        """End a gatekeeper that was started here at once, with its simulated robot, without waiting."""
        if (process := self._connection.process) is not None:
            process.process.kill()

    def __enter__(self) -> Self:
        """The robot itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the robot."""
        self.close()

    def _receive(self, message: Message) -> None:
        """Keep an event of the gatekeeper; called by the thread that reads from it."""
        if isinstance(message, EventReport):
            self._feed.add(message.t, message.kind, message.text, message.data)

    def _send_stop(self, *, emergency: bool) -> None:
        if not emergency:
            self._connection.client.operate("abort")
        elif problem := send_emergency_stop(self._connection.socket):
            raise ConnectionLostError(problem)

    def _scene_report(self) -> SceneReport:
        return self._connection.client.request_scene()


def _retry_file(socket: Path) -> Path:
    """The file of the contracts that were submitted to the gatekeeper at `socket`."""
    name = hashlib.sha256(str(socket.resolve()).encode()).hexdigest()[:16]
    return dualbrain_home() / RETRY_FOLDER / f"{name}.jsonl"


def contract_bytes(contract: Json) -> bytes:
    """The bytes of a contract that are checked and executed."""
    if isinstance(contract, bytes):
        return contract
    return contract.encode("utf-8", "surrogatepass") if isinstance(contract, str) else msgspec.json.encode(contract)
