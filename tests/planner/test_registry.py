"""Opening planners by name, file or address, and errors that name the remedy."""

from pathlib import Path

import pytest

from dualbrain.errors import MissingDependencyError, UnknownNameError
from dualbrain.planner.backends.openai_server import ServerPlanner
from dualbrain.planner.registry import DEFAULT_PLANNER, SMALL_PLANNER, open_planner, planner_names
from dualbrain.planner.scripted import ScriptedPlanner
from tests.planner.sample_requests import plan_request


def test_the_planners_are_the_language_models_of_the_manifest() -> None:
    assert set(planner_names()) == {DEFAULT_PLANNER, "qwen2.5-coder-0.5b-instruct", SMALL_PLANNER}


def test_missing_weights_name_the_command_that_fetches_them(tmp_path: Path) -> None:
    with pytest.raises(MissingDependencyError, match=f"dualbrain models fetch {DEFAULT_PLANNER}"):
        open_planner(DEFAULT_PLANNER, tmp_path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(MissingDependencyError, match="mine"):
        open_planner(str(tmp_path / "mine.gguf"), tmp_path)


@pytest.mark.parametrize("name", ["gpt", "minilm-l6-v2-int8", ""])
def test_an_unknown_planner_lists_the_known_ones(name: str, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="smollm2"):
        open_planner(name, tmp_path)


def test_an_address_without_its_scheme_is_not_shown(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError) as raised:
        open_planner("user:pa55word@host/v1#m", tmp_path)
    assert "pa55word" not in f"{raised.value} {vars(raised.value)}"


def test_an_address_names_the_model_after_the_hash_sign(tmp_path: Path) -> None:
    planner = open_planner("http://localhost:8000/v1#qwen", tmp_path)
    assert isinstance(planner, ServerPlanner)
    assert planner.name == "qwen@localhost"
    planner.close()


@pytest.mark.parametrize("dialect", ["vllm", "llama.cpp", "llguidance", "ollama", "free", "openai"])
def test_an_address_may_name_its_dialect(dialect: str, tmp_path: Path) -> None:
    planner = open_planner(f"{dialect}+http://localhost:8000/v1#qwen", tmp_path)
    assert isinstance(planner, ServerPlanner)
    assert (planner.name, planner.dialect) == ("qwen@localhost", dialect)
    with pytest.raises(UnknownNameError, match="vllm"):
        open_planner("tgi+https://localhost/v1", tmp_path)


def test_a_script_is_proposed_in_order_and_its_end_repeats() -> None:
    planner = ScriptedPlanner(["one", "two"])
    assert [planner.propose(plan_request()).text for _ in range(3)] == ["one", "two", "two"]
    assert len(planner.requests) == 3
    planner.close()
