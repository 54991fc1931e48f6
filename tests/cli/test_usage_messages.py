"""Messages for mistakes of a first use: each is a sentence that states the remedy."""

import pytest

from dualbrain.cli.main import run_command_line

SEEDED_COMMANDS = [
    [*command, "--seed", "-1"]
    for command in (["run", "x"], ["shell"], ["gatekeeper"], ["mcp"], ["console"], ["fault", "state", "off"])
]
COMMANDS_WITH_A_PORT = [
    [*command, "--port", "99999"]
    for command in (["run", "x"], ["shell"], ["scene", "new", "a.json"], ["robot", "inspect", "--view"])
]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["run", "put", "the", "red", "cube"], 'must be one argument in quotes: dualbrain run "put the red cube"'),
        (["plan", "hold", "still", "--robot", "panda"], 'dualbrain plan "hold still"'),
        (["demo", "--headless", "put", "it"], 'dualbrain demo "put the red cube in the bowl"'),
        (["plan", ""], "The instruction is empty."),
        (["plan", "x", "--shots", "0"], "--shots: got 0, allowed: 1 to 5."),
        (["run", "x", "--headless", "--speed", "50%"], "Add --live, or leave out --speed."),
        (["operate", "speed"], "dualbrain operate speed --speed 25%"),
        (["mcp", "--socket", "s", "--speed", "10%"], "The operator sets the speed: dualbrain operate speed"),
        (["console", "--socket", "s", "--scene", "8"], "--scene belongs to a simulated robot"),
        (["mcp", "--host", "0.0.0.0"], "Add --http PORT, or remove them."),
    ],
)
def test_a_usage_error_states_the_correct_call(arguments, expected, capsys):
    assert run_command_line(arguments) == 2
    printed = capsys.readouterr()
    assert expected in printed.err
    assert "Unused Tokens" not in printed.err
    assert not printed.out


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        *((command, '"-1" for --seed. Must be >= 0.') for command in SEEDED_COMMANDS),
        *((command, '"99999" for --port. Must be <= 65535.') for command in COMMANDS_WITH_A_PORT),
        (["run", "x", "--port", "0"], '"0" for --port. Must be >= 1.'),
        (["scene", "show", "8", "--image", "scene.txt"], "--image: got 'scene.txt', allowed: the name of a PNG file"),
        (["robot", "init", "arm.urdf", "--lock", "elbow=nan"], "--lock: got 'elbow=nan', allowed: JOINT=VALUE"),
    ],
)
def test_a_number_out_of_range_is_a_usage_error(arguments, expected, capsys):
    """Each of them ended with a traceback, some of them after the run folder and the ledger were written."""
    assert run_command_line(arguments) == 2
    assert expected in " ".join(capsys.readouterr().err.replace("│", " ").split())


def test_an_unknown_option_is_reported_by_name(capsys):
    assert run_command_line(["run", "x", "--planet", "y"]) == 2
    assert "--planet" in capsys.readouterr().err


def test_the_help_shows_no_default_that_means_not_given(capsys):
    for command in (["run"], ["robot", "init"], ["memory", "search"], ["report"]):
        assert run_command_line([*command, "--help"]) == 0
        text = " ".join(capsys.readouterr().out.split())
        assert "--empty-" not in text
        for default in ('""', "()", "-1", "None"):
            assert f"[default: {default}]" not in text


def test_the_folder_of_a_single_run_has_its_own_report(tmp_path, capsys):
    for name in ("config.json", "episode.json"):
        (tmp_path / name).write_text("{}")
    assert run_command_line(["report", str(tmp_path)]) == 5
    assert f"The report of the run is {tmp_path / 'report.html'}." in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        (["memory", "list", "--status", "activ"], 2, '"active"'),
        (["memory", "list", "--outcome", "succeded"], 2, '"succeeded"'),
        (["memory", "list", "--limit", "-1"], 2, "--limit: got -1"),
        (["memory", "search", "x", "--k", "0"], 2, "--k: got 0, allowed: at least 1."),
        (["knowledge", "search", "x", "--k", "0"], 2, "--k: got 0, allowed: at least 1."),
        (["knowledge", "add", "none.md"], 5, "There is no file none.md."),
        (["models", "fetch"], 2, "dualbrain models fetch"),
        (["models", "fetch", "base-135"], 5, "Closest: 'base-135m'"),
        (["replay", "."], 5, "dualbrain replay episode.mcap"),
        (["export", "lerobot", "--out", "x"], 2, "dualbrain export lerobot runs/a --out data/cubes"),
        (["export", "lerobot", "none", "--out", "x", "--fps", "0"], 2, "--fps: got 0, allowed: 1 to 1000."),
        (["export", "lerobot", "none", "--out", "x"], 5, "none is no recorded run: there is no none."),
        (["replay", "none.mcap"], 5, "There is no recording none.mcap."),
    ],
)
def test_a_wrong_value_is_reported_with_the_known_ones(arguments, code, expected, run_command):
    got, out, err = run_command(*arguments)
    assert (got, out) == (code, "")
    assert expected in err


def test_documents_about_an_unknown_robot_are_rejected(run_command, tmp_path):
    (tmp_path / "rule.md").write_text("# Rule\n\nKeep the gate closed.\n")
    code, _, err = run_command("knowledge", "add", "rule.md", "--robot", "pandda")
    assert (code, "Closest: 'panda'" in err) == (5, True)
