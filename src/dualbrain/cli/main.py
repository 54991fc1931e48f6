"""The command line: every command is registered here and imported only when it runs."""

from __future__ import annotations

import shlex
import traceback
from itertools import takewhile
from typing import cast

from cyclopts import App, CycloptsError, CycloptsPanel, Parameter
from cyclopts.exceptions import UnusedCliTokensError

from dualbrain import __version__
from dualbrain.cli.common.console import StderrConsole, VisibleConsole, print_message, redirect_stdout_to_null
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.core.lazy_exports import missing_dependency
from dualbrain.core.paths import secure_home
from dualbrain.core.storage.atomic_files import WRITE_REMEDIES, write_remedy
from dualbrain.core.untrusted.visible_text import visible_text
from dualbrain.errors import DualbrainError, UsageError

INSTRUCTION_COMMANDS = ("run", "plan", "demo")
"""Commands whose only positional argument is an instruction."""
HELP_FLAGS = frozenset({"--help", "-h"})
EXAMPLE_INSTRUCTION = "put the red cube in the bowl"


def _format_default(value: object) -> str | None:
    """A default as the help shows it; None for a value that means "not given"."""
    match value:
        case None | False | "" | () | -1:
            return None
        case tuple():
            return ", ".join(map(str, cast("tuple[object, ...]", value)))
        case _:
            return str(value)


app = App(
    name="dualbrain",
    version=__version__,
    help="""Lets a language model plan for a robot without trusting it: plans are typed contracts that a gate validates,
    and every command passes a local safety filter.

    Start with `dualbrain demo`, then `dualbrain run "put the red cube in the bowl"`. Shell completion:
    `dualbrain --install-completion`.

    Exit codes: 0 success, 1 the task failed safely, 2 usage, 3 contract rejected or declined, 4 a safety violation was
    observed, 5 broken set-up, 6 not judged, 130 interrupted.""",
    help_format="markdown",
    console=VisibleConsole(),
    default_parameter=Parameter(show_default=_format_default, negative_iterable=""),
    suppress_keyboard_interrupt=False,  # an interruption is reported by `run_command_line`
)
app.register_install_completion_command(help="Install completion for this shell (bash, zsh or fish).")

app.command("dualbrain.cli.run.run:run", name="run", help="Run one instruction on a simulated robot.")
app.command(
    "dualbrain.cli.run.plan:plan",
    name="plan",
    help="""Ask the planner for a contract without moving a robot, and print every step.

    Prints the prompt as the model reads it, the answer (the contract), the verdict of the three stages of the gate, the
    retrieved memories with the parts of their score R = λ_s s + (1 − λ_s) w, the retrieved passages with citations
    (`dualbrain knowledge show CITATION` quotes them), and the planning time. The robot is at its home position and the
    scene is known exactly. Memory is only read. Caches that a run would create are created: the built-in documents at
    their first use (with `--knowledge on`), model states and converted weights, the canary results of an adapter,
    and with `shadow:` the log of the candidate.

    Examples: `dualbrain plan "put the red cube in the bowl"`; `dualbrain plan "throw the red cube at the person"`. Save
    a contract with `--json | jq .contract > c.json` and run it with `dualbrain run --contract c.json`.

    Exit code 0 if the contract was accepted, 3 if it was rejected or the planner declined, 1 if the planner did not
    answer.""",
)
app.command("dualbrain.cli.run.demo:demo", name="demo", help="Run the main example, with a person in the way.")
app.command(
    "dualbrain.cli.run.shell.shell:shell",
    name="shell",
    help="""Give instructions one after another; the planner stays loaded, and objects stay where they were put.

    Every instruction passes the same gate and the same filter as with `dualbrain run`, and has a run folder of its own.
    `stop` and Ctrl-C stop the motion at any time and leave the shell open. The live view has a field for instructions.

    Examples: `dualbrain shell`; `dualbrain shell --live --planner starter-135m`; without a terminal
    `printf 'put the red cube in the bowl\ngo home\n' | dualbrain shell --headless`.""",
)
app.command("dualbrain.cli.run.schema:schema", name="schema", help="Print the contract schema of a robot.")
app.command("dualbrain.cli.run.check:check", name="check", help="Check a contract file with the gate.")
app.command(
    "dualbrain.cli.run.replay:replay", name="replay", help="Recompute a recorded run and compare it bit for bit."
)
app.command(
    "dualbrain.cli.servers.gatekeeper:gatekeeper",
    name="gatekeeper",
    help="Run filter and supervisor as a separate process.",
)
app.command(
    "dualbrain.cli.servers.gatekeeper:operate", name="operate", help="Send operator commands to a running gatekeeper."
)
app.command(
    "dualbrain.cli.servers.mcp:mcp",
    name="mcp",
    help="""Serve a robot to agents over the Model Context Protocol (MCP), on stdin and stdout or over HTTP.

    The server starts a simulated robot behind a gatekeeper, or commands a running one with --socket. It has the rights
    of a commander: contracts pass the gatekeeper's gate, motions its filter, and only a person can release an emergency
    stop. Tools: get_scene, get_schema, check_contract, submit_contract, get_outcome, stop, and do with a --planner. A
    contract that is submitted again with the same id does not move the robot again.

    Examples: `dualbrain mcp --scene 8` as the command of an MCP client; `dualbrain mcp --http 8765`, then the address
    http://127.0.0.1:8765/mcp with the header `Authorization: Bearer TOKEN`. See docs/how-to/agents/connect.md.""",
)
app.command(
    "dualbrain.cli.servers.console:console",
    name="console",
    help="""Show a robot in the browser: live events, a contract editor with the gate's verdict, runs, memory, stops.

    The command starts a simulated robot behind a gatekeeper, or connects to a running one with --socket, and serves the
    page on the loopback interface. The page cannot submit a contract, reset, resume or change the speed: agents submit
    contracts over MCP at the same port, and a person uses `dualbrain operate`.

    Example: `dualbrain console --scene 8`, then open the printed address. See docs/how-to/agents/console.md.""",
)
app.command(
    "dualbrain.cli.servers.metrics:metrics",
    name="metrics",
    help="""Serve metrics of a running gatekeeper to Prometheus: ticks, interventions, filter, supervisor, contracts.

    The command is an observer on the gatekeeper's socket: it has no key, commands nothing, and runs outside the control
    loop, which counts every tick itself. The page is served on the loopback interface only. While the gatekeeper does
    not answer, `dualbrain_up` is 0, and the command connects again once it does.

    Example: `dualbrain gatekeeper` in one terminal, `dualbrain metrics` in another, then
    `curl http://127.0.0.1:9107/metrics`. The page docs/reference/safety/metrics.md lists all metrics and configures
    Prometheus.""",
)
app.command("dualbrain.cli.run.fault:fault", name="fault", help="Inject one fault into a simulated task.")
app.command(
    "dualbrain.cli.adapters.adapt:adapt", name="adapt", help="Fine-tune an adapter of the planner on recorded episodes."
)
app.command("dualbrain.cli.doctor:doctor", name="doctor", help="Check this installation.")
app.command(
    "dualbrain.cli.evaluation.evaluate:evaluate",
    name="evaluate",
    help="""Run the evaluation protocol of the paper; an interrupted evaluation can be resumed.

    Every method runs the same scenes, seeds and instructions; the results are one Parquet file. Passes, each resumable:
    ε from pilot episodes, the ledger from which all methods with memory start, the planner's answers (stored by
    question), the episodes. After an interruption of any kind, the same command with the same --out continues.

    Examples: `dualbrain evaluate --suite smoke --out runs/smoke`, then `dualbrain report runs/smoke`, and `dualbrain
    compare DIR DIR`. `--dry-run` estimates the duration of a suite. Methods, metrics and rules:
    docs/reference/evaluation.md.""",
)
app.command(
    "dualbrain.cli.evaluation.report:report",
    name="report",
    help="""Write the report of an evaluation as one HTML file and as a Markdown page.

    Writes report.html (works offline, without scripts) into the folder, and a Markdown page with its images into page/
    or the folder given by --page: verdicts on the hypotheses of the paper with intervals, methods × metrics, curves
    over repetitions, traces, failures with images, latencies, and a list of quantities that were not measured.
    `dualbrain report runs/smoke --gallery 0` does not simulate failures again for images.""",
)
app.command(
    "dualbrain.cli.evaluation.report:compare",
    name="compare",
    help="""Compare two evaluations: the changes whose direction is known, and the differences of their configurations.

    Prints the differences of their configurations. Then, over the methods, scenes, seeds and repetitions that both
    contain, and for each method and metric that is better or worse: the second minus the first, its interval over
    common clusters, and the p value corrected for multiple comparisons (Holm). `--all` prints every metric.""",
)

evidence = App(name="evidence", help="Write and verify the evidence for a safety engineer: one folder.")
app.command(evidence)
evidence.command(
    "dualbrain.cli.evaluation.evidence:write", name="write", help="Write the evidence for a robot at a site."
)
evidence.command("dualbrain.cli.evaluation.evidence:verify", name="verify", help="Compare a folder with its manifest.")
evidence.command(
    "dualbrain.cli.evaluation.evidence:list_tests", name="tests", help="List the tests of the requirements, for pytest."
)

app.command("dualbrain.cli.scenes.commands:list_scenes", name="scenes", help="List the scene families of a robot.")
scene = App(name="scene", help="Show one scene, or arrange a new one in a page.")
app.command(scene)
scene.command("dualbrain.cli.scenes.commands:show_scene", name="show", help="Print a scene as a table, with an image.")
scene.command("dualbrain.cli.scenes.commands:new_scene", name="new", help="Arrange a scene in a page, and save it.")

export = App(name="export", help="Write recorded runs in the formats of other programs.")
app.command(export)
export.command(
    "dualbrain.cli.evaluation.export_lerobot:export_lerobot",
    name="lerobot",
    help="Write recorded runs as one LeRobotDataset v3, which LeRobot 0.6 loads and trains from.",
)
export.command(
    "dualbrain.cli.evaluation.export_trace:export_trace",
    name="trace",
    help="Write a finished run as an OpenTelemetry trace: retrieval, planner requests, checks by the gate, actions.",
)

memory = App(name="memory", help="Inspect, audit and edit the episode memory. Every edit can be undone.")
app.command(memory)
for _name, _function, _help in (
    ("list", "browse:list_memories", "List memories with outcome, Δ, weight and status."),
    ("show", "browse:show", "Show one memory with every change of its weight."),
    ("search", "browse:search", "Search as a run would, with all parts of the score."),
    ("export", "browse:export", "Write all memories as JSON lines."),
    ("verify", "browse:verify", "Verify the hash chain, anchors, weights, snapshot and vectors."),
    ("audit", "edit:audit", "Report label conflicts, near-duplicates and the influence of each source."),
    ("quarantine", "edit:quarantine", "Exclude memories, and undo their influence on weights."),
    ("release", "edit:release", "Undo a quarantine."),
    ("forget", "edit:forget", "Mark memories as forgotten."),
    ("rollback", "edit:rollback", "Restore the memory as it was at an event."),
    ("replay", "edit:replay", "Run a remembered contract again in simulation."),
    ("compact", "edit:compact", "Write a shorter ledger with the same weights, and archive the original."),
    ("rebuild", "edit:rebuild", "Recompute all vectors."),
    ("connect", "connect:connect", "Share a ledger with other robots, on a PostgreSQL server."),
):
    memory.command(f"dualbrain.cli.memory.{_function}", name=_name, help=_help)

models = App(name="models", help="List and download model weights.")
app.command(models)
models.command("dualbrain.cli.models:list_models", name="list", help="List the planners and model files.")
models.command("dualbrain.cli.models:fetch", name="fetch", help="Download model files by name.")

robot = App(
    name="robot", help="Import a robot from its description, inspect it, identify its tracking model, commission it."
)
app.command(robot)
robot.command("dualbrain.cli.robot.init:init", name="init", help="Import a robot from its URDF or MJCF file.")
robot.command("dualbrain.cli.robot.inspect:inspect", name="inspect", help="Show the robot model that the filter uses.")
robot.command(
    "dualbrain.cli.robot.identify:identify",
    name="identify",
    help="""Identify how closely the drive of a simulated robot follows its commands.

    The safety filter assumes that y = q + lag v moves at the velocity u that it commands. This command moves the
    simulated robot at full speed and acceleration (sines, bang-bang, and straight at the nearest limit), once with an
    empty hand and once with an undeclared load. It identifies the lag that explains most of the motion and the
    remaining error e: the largest leaky integral of ẏ − u over all joints and runs, times 1.25. The rows of the filter
    then keep the margin α e.

    `dualbrain robot identify --write my_panda.json` writes the values to a robot model file, which is created if
    necessary. For a real arm pass your own measurement: `FilterConfig(tracking_error=...)`.""",
)
robot.command("dualbrain.cli.robot.conform:conform", name="conform", help="Test a driver against the driver contract.")
robot.command(
    "dualbrain.cli.robot.firmware:export_c",
    name="export-c",
    help="Write a robot as C tables for the firmware of a microcontroller.",
)
robot.command(
    "dualbrain.cli.robot.firmware:firmware",
    name="firmware",
    help="Build the firmware of the safety layer for a robot and a board, and try it on the emulated board.",
)
robot.command(
    "dualbrain.cli.robot.commission:commission",
    name="commission",
    help="Fill in and sign the commissioning checklist of a real arm.",
)

ros2 = App(name="ros2", help="Put the safety filter under the controllers of ROS 2.")
app.command(ros2)
ros2.command("dualbrain.cli.robot.ros2:node", name="node", help="Guard commands between a policy and a controller.")
ros2.command(
    "dualbrain.cli.robot.ros2:tables", name="tables", help="Write robot and obstacles for the ros2_control controller."
)

adapters = App(name="adapters", help="List, promote and export adapters of the planner.")
app.command(adapters)
for _name, _function, _help in (
    ("list", "registry:list_adapters", "List adapters, and the one in use."),
    ("show", "registry:show", "Show the card and the history of one adapter."),
    ("verify", "registry:verify", "Verify the weights of all adapters against their ids."),
    ("promote", "registry:promote", "Use an adapter, if it was measured better."),
    ("rollback", "registry:rollback", "Return to the previous adapter."),
    ("history", "registry:history", "List promotions and rollbacks."),
    ("measure", "measure:measure", "Measure a candidate and the current adapter for a promotion."),
    ("export", "export:export", "Export an adapter for peft, vLLM, llama.cpp or the Hugging Face Hub."),
    ("diff", "export:diff", "Compare two adapters."),
    ("explore", "explore:explore", "Adapt a planner by exploration in simulation."),
    ("make", "make:make", "Reproduce a packaged adapter."),
):
    adapters.command(f"dualbrain.cli.adapters.{_function}", name=_name, help=_help)

knowledge = App(
    name="knowledge",
    help="""Manage the documents that a planner may read: rules, manuals, maps and templates.

    `dualbrain knowledge add manual.pdf --trust vendor` reads the visible text of a document, `search "how hard may I
    grip"` finds passages, `show CITATION` quotes one exactly, in any version. `dualbrain run` puts up to three passages
    about the task from documents of trust `site` into the prompt, as data, and with `--knowledge on` from packaged ones
    and those of trust `vendor`, too; the report lists them. The contract passes the same gate and the same filter.""",
)
app.command(knowledge)
for _name, _function, _help in (
    (
        "add",
        "add",
        "Add documents: Markdown, text, HTML, PDF, or a map or templates in TOML or JSON. "
        "Hidden text is removed and reported; a changed document is a new version. Exit code 5 if one is rejected.",
    ),
    ("list", "list_documents", "List the documents."),
    ("search", "search", "Search passages that answer a question, each with the citation that quotes it."),
    ("show", "show", "Print a stored document, or the exact text of a citation; its history on stderr."),
    ("remove", "remove", "Remove documents; their citations can still be quoted."),
    ("rebuild", "rebuild", "Rebuild the index of words and vectors, for example after a change of the encoder."),
):
    knowledge.command(f"dualbrain.cli.knowledge:{_function}", name=_name, help=_help)


def run_command_line(arguments: list[str]) -> int:
    """Run one command and return its exit code; an exception becomes a message on stderr."""
    secure_home()
    try:
        if not HELP_FLAGS.isdisjoint(arguments):
            _describe_command(arguments)
        return int(app(arguments, exit_on_error=False, print_error=False, result_action="return_value") or 0)
    except CycloptsError as error:
        return _print_usage_error(error)
    except KeyboardInterrupt:
        print_message("dualbrain: interrupted")
        return ExitCode.INTERRUPTED
    except BrokenPipeError:  # only listings: commands with a verdict handle a closed pipe themselves
        redirect_stdout_to_null()
        return ExitCode.SUCCESS
    except ModuleNotFoundError as error:
        return _print_error(missing_dependency(error, "this command"))
    except Exception as error:
        return _print_error(error)


def _describe_command(arguments: list[str]) -> None:
    """Let the help of the named command be its docstring, unless a longer text is registered above.

    The lists of commands show the registered line, because a command is imported only when it runs.
    """
    _, apps, _ = app.parse_commands(list(takewhile(lambda word: word not in HELP_FLAGS, arguments)))
    command = apps[-1]
    is_ours = getattr(command.default_command, "__module__", "").startswith("dualbrain.")
    if is_ours and "\n" not in (command.help or ""):
        command.help = None


def _print_usage_error(error: CycloptsError) -> ExitCode:
    """Print the error: one sentence if the words of an instruction were not quoted, else the panel of cyclopts."""
    arguments, unused = error.root_input_tokens or [], error.unused_tokens or []
    of_instruction = isinstance(error, UnusedCliTokensError) and arguments[0] in INSTRUCTION_COMMANDS
    if of_instruction and not any(word.startswith("-") for word in unused):
        words = arguments[1 : len(unused) + 2]
        instruction = " ".join(words) if words[1:] == unused else EXAMPLE_INSTRUCTION
        quoted = f'"{instruction}"' if instruction.replace(" ", "").isalnum() else shlex.quote(instruction)
        sentence = f"The instruction must be one argument in quotes: dualbrain {arguments[0]} {quoted}"
        print_message(f"dualbrain: {sentence}")
    else:
        StderrConsole().print(CycloptsPanel(visible_text(str(error), keep_lines=True)), soft_wrap=False)
    return ExitCode.USAGE


def _print_error(error: Exception) -> ExitCode:
    """Print the error; an unexpected exception is printed with its traceback."""
    match error:
        case DualbrainError():
            print_message(f"dualbrain: {error}")
        case OSError():
            print_message(f"dualbrain: {_describe_os_error(error)}")
        case _:
            print_message("".join(traceback.format_exception(error)).rstrip("\n"))
    return ExitCode.USAGE if isinstance(error, UsageError) else ExitCode.SETUP


def _describe_os_error(error: OSError) -> str:
    """A sentence about a file, and the remedy."""
    match error:
        case FileNotFoundError(filename=str(name)):
            return f"There is no file or folder {name}. Check the path."
        case FileExistsError(filename=str(name)):
            return f"{name} exists already. Name a new file, or delete this one."
        case IsADirectoryError(filename=str(name)):
            return f"{name} is a folder. Name a file."
        case PermissionError(filename=str(name)):
            return f"{name} may not be read or written by this user. Change its permissions, or name another path."
        case _ if error.errno in WRITE_REMEDIES:
            return f"{error.filename or 'A file'} cannot be written: {error.strerror}. {write_remedy(error)}"
        case _:
            return f"{error.strerror or error}: {error.filename or ''}".rstrip(": ")
