"""Checks of planners, adapters and weights before a suite runs."""

import msgspec
import pytest

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.compatibility import registry_hashes
from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.errors import ConfigurationError, MissingDependencyError, UnknownNameError
from dualbrain.evaluation.planners.factory import (
    RANDOM_PLANNERS,
    PlannerSources,
    check_planners,
)
from dualbrain.evaluation.protocol.suite import (
    MemorySettings,
    load_suite,
    parse_suite,
)
from dualbrain.evaluation.runner import preflight
from dualbrain.evaluation.runner.runner import STAGES
from dualbrain.evaluation.runner.work_units import build_units
from dualbrain.planner.registry import planner_names
from dualbrain.robots.loader import BUILTIN_ROBOTS
from dualbrain.simulation.tasks.families import task_families_for
from tests.evaluation.sample_rows import SUITE


@pytest.fixture
def suite():
    return parse_suite(SUITE, "tiny.toml")


def test_a_missing_planner_is_reported_before_the_suite_runs(suite):
    check_planners(suite)
    with pytest.raises(
        ConfigurationError,
        match=r"role adapted, which method P needs.*--planner adapted=adapter:ID",
    ):
        check_planners(msgspec.structs.replace(suite, methods=("B3", "P")))
    with pytest.raises(ConfigurationError, match="may be another adapter tomorrow"):
        check_planners(msgspec.structs.replace(suite, planners={"base": "adapter:champion"}))
    with pytest.raises(ConfigurationError, match=r"B1-free needs unconstrained decoding.*Leave out B1-free"):
        check_planners(msgspec.structs.replace(suite, methods=("B3", "B1-free")))
    check_planners(msgspec.structs.replace(suite, methods=("B1-free",), planners={"base": "base-135m"}))


@pytest.mark.parametrize(
    ("planners", "message"),
    [
        ({"base": "nosuch"}, "'nosuch' is not a planner.*base-135m.*template"),
        ({"base": ""}, "'' is not a planner"),
        ({"base": "adapter:"}, "is not a planner"),
        ({"base": "transformers:template"}, "is not a planner"),
        ({"base": "transformers:x.gguf"}, "is not a planner"),
        ({"base": "shadow:ab@nosuch"}, "is not a planner"),
        ({"base": "shadow:ab@template"}, "is not a planner"),
        ({"base": "ftp://host/v1"}, "planner address"),
        ({"base": "template", "foo": "template"}, "'foo' is not a planner role.*adapted"),
        ({"base": "transformers:adapter:champion"}, "may be another adapter tomorrow"),
        ({"base": "shadow:ab"}, "may be another adapter tomorrow"),
    ],
)
def test_an_unknown_planner_or_role_is_rejected_by_name(suite, planners, message):
    with pytest.raises((ConfigurationError, UnknownNameError), match=message):
        check_planners(msgspec.structs.replace(suite, planners=planners))


@pytest.mark.parametrize(
    "name",
    [
        *RANDOM_PLANNERS,
        *planner_names(),
        *packaged_names(),
        "transformers:base-135m",
        "adapter:ab",
        "transformers:adapter:ab",
        "http://host:8000/v1#model",
        "vllm+http://host/v1",
        "https://host/v1?api-version=1#model",
        "my/model.gguf",
        "shadow:ab@base-135m",
    ],
)
def test_every_form_of_planner_name_is_accepted_also_for_unused_roles(suite, name):
    check_planners(msgspec.structs.replace(suite, planners={"base": name, "adapted_no_kl": name}))


@pytest.mark.parametrize("name", ["https://user:pa55word@host/v1#m", "https://host/v1?api-version=1&key=pa55word#m"])
def test_an_address_with_a_secret_is_refused_because_results_record_it(suite, name):
    with pytest.raises(ConfigurationError, match=r"role base.*OPENAI_API_KEY") as raised:
        check_planners(msgspec.structs.replace(suite, planners={"base": name}))
    assert "pa55word" not in f"{raised.value} {vars(raised.value)}"


def test_pilot_episodes_need_a_base_planner(suite):
    pilot = MemorySettings(epsilon="pilot", pilot=2)
    alone = msgspec.structs.replace(suite, methods=("PE",), planners={"prompted": "template"}, memory=pilot)
    with pytest.raises(ConfigurationError, match="role base, which the pilot episodes need"):
        check_planners(alone)


def test_an_adapter_must_exist_and_be_trained_for_the_robot(suite, tmp_path):
    sources = PlannerSources(tmp_path, tmp_path)

    def check(robot="panda", **planners):
        here = msgspec.structs.replace(suite, planners={"base": "template"} | planners, robots=(robot,))
        preflight.require_adapters(here, build_units(here, "fly"), sources)

    check(adapted="base-135m", base="transformers:starter-135m")  # their base models need not be installed
    for name in ("adapter:deadbeef", "transformers:adapter:deadbeef", "shadow:deadbeef@template"):
        with pytest.raises(UnknownNameError, match="deadbeef"):
            check(adapted=name)
    with pytest.raises(MissingDependencyError):
        check(adapted=f"adapter:{tmp_path}/none")
    trained = registry_hashes(read_adapter_card(packaged_folder("starter-135m")))
    untrained = next(robot for robot in BUILTIN_ROBOTS if robot not in trained)
    assert "clutter_grasp" in task_families_for(untrained)
    check(untrained, adapted="starter-135m")  # no method uses it here
    with pytest.raises(ConfigurationError, match=untrained):
        check(untrained, base="starter-135m")


def test_a_missing_model_file_is_reported_beforehand(tmp_path):
    with pytest.raises(MissingDependencyError, match="model file"):
        preflight.require_planner_files(str(tmp_path / "none.gguf"), "panda", PlannerSources(tmp_path, tmp_path))


@pytest.mark.parametrize(
    ("name", "methods", "planners"),
    [
        ("tiny", ("M",), {"template"}),
        ("large", ("M",), {"qwen2.5-coder-1.5b-instruct"}),
        ("large", ("B3",), {"qwen2.5-coder-1.5b-instruct"}),
        ("smoke", ("M",), {"base-135m"}),
    ],
)
def test_every_planner_that_will_be_used_is_checked_beforehand(suite, tmp_path, monkeypatch, name, methods, planners):
    chosen = suite if name == "tiny" else load_suite(name)
    chosen = msgspec.structs.replace(chosen, methods=methods)
    if name == "smoke":
        chosen = msgspec.structs.replace(chosen, planners={"base": "base-135m"})
    checked = set()
    monkeypatch.setattr(preflight, "require_planner_files", lambda name, robot, sources: checked.add(name))
    monkeypatch.setattr(preflight, "locate_weights", lambda name, cache: None)
    units = [unit for stage in STAGES for unit in build_units(chosen, stage)]
    preflight.require_dependencies(chosen, units, PlannerSources(tmp_path, tmp_path))
    assert checked - {"template"} == planners - {"template"}
