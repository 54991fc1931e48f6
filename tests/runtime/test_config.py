"""The stored configuration of a run."""

import json

from dualbrain.runtime.config import RunConfig, default_config
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


def test_a_run_of_a_user_reads_documents_if_the_planner_does(tmp_path, monkeypatch):
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path))
    assert default_config("go home").consult == "auto"
    assert RunConfig(instruction="", out=tmp_path, ledger=tmp_path / "l", cache=tmp_path).consult == "off"


def test_the_stored_configuration_has_the_field_names_of_earlier_versions(tmp_path):
    stored = json.loads(run_config(tmp_path, image_memory=True).encode())
    assert tuple(stored) == STORED_FIELDS
    assert stored["eyes"] is True
    assert stored["out"] == str(tmp_path / "run")
