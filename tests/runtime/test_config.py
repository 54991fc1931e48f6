"""The stored configuration of a run."""

import json

from tests.stories.story_session import run_config

STORED_FIELDS = (
    "instruction",
    "out",
    "ledger",
    "cache",
    "robot",
    "scene",
    "planner",
    "contract",
    "guard",
    "seed",
    "shots",
    "tries",
    "knowledge",
    "consult",
    "map",
    "site",
    "goal",
    "measured",
    "visuals",
    "eyes",
    "utility",
    "static",
    "epsilon",
    "adapters",
)


def test_the_stored_configuration_has_the_field_names_of_earlier_versions(tmp_path):
    stored = json.loads(run_config(tmp_path, image_memory=True).encode())
    assert tuple(stored) == STORED_FIELDS
    assert stored["eyes"] is True
    assert stored["out"] == str(tmp_path / "run")


def test_the_stored_configuration_has_no_password_of_a_planner(tmp_path):
    config = run_config(tmp_path, planner="vllm+https://user:pa55word@host/v1?key=pa55word#m")
    assert json.loads(config.encode())["planner"] == "vllm+https://host/v1#m"
