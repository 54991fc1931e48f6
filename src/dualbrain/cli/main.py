"""The command line: one line per command here, one file per command beside it; heavy rooms are imported late."""

from __future__ import annotations

import sys
import traceback

from cyclopts import App, CycloptsError

from dualbrain import __version__
from dualbrain.cli.common.console import redirect_stdout_to_null
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.errors import DualbrainError, UsageError

app = App(
    name="dualbrain",
    version=__version__,
    help="""A language model proposes, a local safety filter disposes.

    Start with `dualbrain demo`, then `dualbrain run "put the red cube in the bowl"`.

    Exit codes: 0 success, 1 the task failed safely, 2 usage, 3 contract rejected or declined, 4 a safety violation was
    seen, 5 broken set-up, 130 interrupted.""",
    help_format="markdown",
    suppress_keyboard_interrupt=False,  # else it would leave by itself, and say nothing
)
memory = App(name="memory", help="What happened: look at memory, audit it, mend it. Everything is reversible.")
app.command(memory)
models = App(name="models", help="Model weights: what there is, and fetch it.")
app.command(models)
adapters = App(name="adapters", help="Adapters of the planner: which there are, which one serves, and why.")
app.command(adapters)
robot = App(
    name="robot", help="Robots: `init` makes one from its description, `identify` measures how it follows its commands."
)
app.command(robot)
knowledge = App(
    name="knowledge",
    help="""Documents that a planner may be shown: rules, manuals, maps, templates.

    `dualbrain knowledge add manual.pdf --trust vendor` reads what a person would see of it, `search "how hard may I
    grip"` finds passages, `show CITATION` quotes one exactly, in any version. `dualbrain run --knowledge on` puts up to
    three passages that bear on the task into the prompt, as data; the report lists them. A planner is shown only
    documents of trust `site` or `vendor`; whatever they say, its contract passes the same gate and the same filter.""",
)
app.command(knowledge)

app.command("dualbrain.cli.run.run:run", name="run", help="Words become safe motion.")
app.command(
    "dualbrain.cli.run.plan:plan",
    name="plan",
    help="""What the planner would do, shown whole; nothing moves, and memory is only read.

    Shows, in this order: the prompt as the model reads it; its answer, which is the contract; the verdict of the gate's
    three stages; what was retrieved (memories with the parts of their score R = λ_s s + (1 − λ_s) w, passages with
    citations that `dualbrain knowledge show CITATION` quotes); where the time of the decision went. The robot stands at
    home and sees the scene without error. Written is only what a run would keep for the next question: the shipped
    documents at their first use (not with `--knowledge off`), states and converted weights of models in the cache, an
    adapter's canaries, and with `shadow:` the log of the candidate.

    Try `dualbrain plan "put the red cube in the bowl"`; see what becomes of a bad idea with `dualbrain plan "throw the
    red cube at the person"`; save a contract with `--json | jq .contract > c.json` and run it: `dualbrain run
    --contract c.json`.

    Exits 0 if the contract was accepted, 3 if it was rejected or the planner declined.""",
)
app.command("dualbrain.cli.run.demo:demo", name="demo", help="The main job in one command.")
app.command("dualbrain.cli.run.schema:schema", name="schema", help="Print a robot's contract schema.")
app.command("dualbrain.cli.run.check:check", name="check", help="What the gate says of a contract file.")
app.command("dualbrain.cli.run.replay:replay", name="replay", help="Compute a recorded run again, bit for bit.")
app.command("dualbrain.cli.gatekeeper:gatekeeper", name="gatekeeper", help="The spinal cord as a process.")
app.command("dualbrain.cli.gatekeeper:operate", name="operate", help="A person's hand on a gatekeeper.")
app.command("dualbrain.cli.run.fault:fault", name="fault", help="Break one thing at the worst moment, and look.")
app.command("dualbrain.cli.adapters.adapt:adapt", name="adapt", help="Learn from what went well: fit an adapter.")
app.command("dualbrain.cli.doctor:doctor", name="doctor", help="Examine this installation.")
app.command(
    "dualbrain.cli.evaluation.evaluate:evaluate",
    name="evaluate",
    help="""Compare methods by the paper's protocol, resumably.

    Every method flies the same scenes, seeds and words; the results are one Parquet file. Passes, each resumable: ε
    from pilot episodes, the ledger that all methods with memory start from, the planner's answers (kept by question),
    the episodes. Killed in any way, the same command with the same --out goes on where it was.

    `dualbrain evaluate --suite smoke --out runs/smoke`, then `dualbrain report runs/smoke`, and `dualbrain compare DIR
    DIR`. `--dry-run` tells how long a suite takes. Methods, metrics and rules: docs/evaluation.md.""",
)
app.command(
    "dualbrain.cli.evaluation.report:report",
    name="report",
    help="""What an evaluation found, as one HTML file.

    Writes report.html (works offline, no script) into the folder, and a Markdown page with its pictures into page/ or
    wherever --page says: verdicts on the paper's hypotheses with their intervals, methods × metrics, curves over
    repetitions, traces, failures with pictures, latencies, and what was not measured. `dualbrain report runs/smoke
    --gallery 0` flies nothing again for pictures.""",
)
app.command(
    "dualbrain.cli.evaluation.report:compare",
    name="compare",
    help="""What changed between two evaluations.

    In what they were set up otherwise; then place by place, the same methods, scenes, seeds and repetitions in both:
    for each method and metric the second minus the first, its interval over common clusters, p values corrected over
    what differs (Holm), and the word that these bear.""",
)
for _name, _function, _help in (
    ("list", "memory.browse:list_memories", "List memories with outcome, Δ, weight and status."),
    ("show", "memory.browse:show", "Show one memory whole, with everything that moved its weight."),
    ("search", "memory.browse:search", "Search as the planner would, with all parts of the score."),
    ("export", "memory.browse:export", "Write all memories as lines of JSON."),
    ("verify", "memory.browse:verify", "Check chain, weights, snapshot and vectors."),
    ("audit", "memory.edit:audit", "Label conflicts, near-duplicates, blast radius of each source."),
    ("quarantine", "memory.edit:quarantine", "Set memories aside, with their influence."),
    ("release", "memory.edit:release", "Bring them back."),
    ("forget", "memory.edit:forget", "Put a tombstone on memories."),
    ("rollback", "memory.edit:rollback", "Make memory what it was at an event."),
    ("replay", "memory.edit:replay", "Run a remembered contract again in simulation."),
    ("compact", "memory.edit:compact", "A short ledger with the same weights; the long one is archived."),
    ("rebuild", "memory.edit:rebuild", "Make all vectors anew."),
):
    memory.command(f"dualbrain.cli.{_function}", name=_name, help=_help)
robot.command("dualbrain.cli.robot.init:init", name="init", help="Make a robot from its URDF or MJCF.")
robot.command("dualbrain.cli.robot.inspect:inspect", name="inspect", help="See what the filter sees of a robot.")
models.command("dualbrain.cli.models:list_models", name="list", help="List the known weights.")
models.command("dualbrain.cli.models:fetch", name="fetch", help="Fetch weights by name.")
robot.command(
    "dualbrain.cli.robot.identify:identify",
    name="identify",
    help="""Measure how well a robot's drive follows its commands.

    The safety filter trusts that y = q + lag v moves at the velocity u it lets through. This command drives the
    simulated robot at full speed and acceleration (sines, bang-bang, and straight at the nearest limit), once with an
    empty hand and once with a load it is not told of, and finds the lag that explains the most and the error e that is
    left: the largest leaky integral of ẏ − u over all joints and runs, times 1.25. Rows then keep α e.

    `dualbrain robot identify --write my_panda.json` puts the figures into a body's data file, which is made if need be.
    For a real arm give the filter your own measurement: `FilterConfig(tracking_error=...)`.""",
)
robot.command("dualbrain.cli.robot.conform:conform", name="conform", help="Try the driver contract on a driver.")
robot.command("dualbrain.cli.robot.commission:commission", name="commission", help="Answer for a real arm.")

for _name, _function, _help in (
    ("list", "list_adapters", "List adapters, and which one serves."),
    ("show", "show", "Show the card of one adapter and what became of it."),
    ("verify", "verify", "Check that all weights are those that their ids name."),
    ("promote", "promote", "Let an adapter serve, if it was measured better."),
    ("rollback", "rollback", "Let the former one serve again."),
    ("history", "history", "List promotions and rollbacks."),
):
    adapters.command(f"dualbrain.cli.adapters.registry:{_function}", name=_name, help=_help)
adapters.command(
    "dualbrain.cli.adapters.measure:measure", name="measure", help="Ask a candidate and the champion, for the gate."
)
adapters.command("dualbrain.cli.adapters.export:export", name="export", help="Write one for peft, vLLM or llama.cpp.")
adapters.command("dualbrain.cli.adapters.export:diff", name="diff", help="Tell two adapters apart.")
adapters.command("dualbrain.cli.adapters.make:make", name="make", help="Make a shipped adapter again.")

for verb, function, words in (
    (
        "add",
        "add",
        "Put documents on the shelf: Markdown, text, HTML, PDF, or a map or templates in TOML or JSON. "
        "What no reader would see is left out and told; a changed document is a new version. Exits 5 if one is refused.",
    ),
    ("list", "list_documents", "List what stands there."),
    ("search", "search", "Find the passages that answer a question, each with the citation that quotes it."),
    ("show", "show", "Print a document as it is kept, or exactly what a citation quotes; its history on stderr."),
    ("remove", "remove", "Take documents off the shelf; what was cited of them can still be quoted."),
    ("rebuild", "rebuild", "Make the index of words and meaning again, for example after a change of the encoder."),
):
    knowledge.command(f"dualbrain.cli.knowledge:{function}", name=verb, help=words)


def main() -> None:
    """Run the command line and leave with its exit code."""
    sys.exit(run_command_line(sys.argv[1:]))


def run_command_line(arguments: list[str]) -> int:
    """Run one command; what it raises becomes a message on stderr and an exit code."""
    try:
        return int(app(arguments, exit_on_error=False, result_action="return_value") or 0)
    except CycloptsError:
        return ExitCode.USAGE
    except KeyboardInterrupt:
        print("dualbrain: interrupted", file=sys.stderr)
        return ExitCode.INTERRUPTED
    except BrokenPipeError:  # only listings get here: what has a verdict survives its reader
        redirect_stdout_to_null()
        return ExitCode.SUCCESS
    except Exception as error:
        return _print_error(error)


def _print_error(error: Exception) -> ExitCode:
    """Say what is broken; a defect is told whole, and not to be taken for a task that failed safely."""
    match error:
        case DualbrainError():
            print(f"dualbrain: {error}", file=sys.stderr)
        case OSError():
            print(f"dualbrain: {error.strerror or error}: {error.filename or ''}".rstrip(": "), file=sys.stderr)
        case _:
            traceback.print_exception(error)
    return ExitCode.USAGE if isinstance(error, UsageError) else ExitCode.SETUP
