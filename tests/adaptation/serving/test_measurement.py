"""Measurements are of the serving runtime, exported adapters compute the same, and differences are reported."""

# ruff: noqa: E402  (nothing is imported where the extras are missing)
import dataclasses
import json
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

for part in ("torch", "peft", "gguf", "xllamacpp"):
    pytest.importorskip(part, reason="the extras `adapt` and `planner` are not installed")
import torch
from peft import PeftModel

from dualbrain.adaptation.adapters import packaged
from dualbrain.adaptation.adapters.base_models import base_model_hash
from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.adapters.comparison import combine_layers, compare_cards, compare_layers
from dualbrain.adaptation.adapters.promotion import MIN_QUESTIONS, MIN_SCENES, Measurement
from dualbrain.adaptation.adapters.registry import AdapterRegistry
from dualbrain.adaptation.adapters.stacking import load_stack
from dualbrain.adaptation.conversion.concatenated_lora import concatenate_adapters, write_peft_adapter
from dualbrain.adaptation.conversion.peft_lora import read_lora
from dualbrain.adaptation.curation.dataset import Dataset, DatasetCard, dataset_hash, write_dataset
from dualbrain.adaptation.curation.sample import Sample, assistant_turn, encode_samples
from dualbrain.adaptation.serving.measurement import measure_planner, select_questions
from dualbrain.adaptation.serving.open_planner import start_llama
from dualbrain.adaptation.serving.perplexity import perplexity
from dualbrain.adaptation.serving.raw_completion import RawCompletion
from dualbrain.cli.adapters import export
from dualbrain.cli.adapters import measure as adapters_measure
from dualbrain.cli.adapters import registry as adapters_command
from dualbrain.core import weights
from dualbrain.core.storage.atomic_files import FileWriteError
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.memory.maintenance.edits import record_adapter
from dualbrain.planner.backends.http_chat import ChatResponse
from dualbrain.planner.backends.llama_cpp import LlamaConfig
from dualbrain.planner.prompt.prompt_format import UNCONSTRAINED_SHORT_PROMPT
from dualbrain.planner.prompt.short_prompt import short_template_hash
from tests.adaptation import tiny_adapter
from tests.adaptation.adapters.test_promotion import trial_results
from tests.adaptation.conversion.test_gguf_lora import PROMPT, llama_log_probs, torch_log_probs
from tests.adaptation.sample_episodes import NOW, distinct_episodes, write_ledger
from tests.adaptation.tiny_gguf import model, random_adapter
from tests.adaptation.tiny_model import tokenizer
from tests.planner.sample_requests import REGISTRY

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::UserWarning")


def contract(thing="red_cube", speed=0.1, skill="grasp"):
    params = {"object": thing, "speed": speed} if skill == "grasp" else {"reason": "no"}
    context = {"robot": REGISTRY.robot, "registry": REGISTRY.hash}
    return json.dumps({"id": "c-0001", "context": context, "action_sequence": [{"skill": skill, "params": params}]})


def sample(number, text=None):
    turns = [{"role": "user", "content": f"question {number}"}]
    return Sample(
        id=f"s{number:02d}",
        prompt=turns,
        completion=assistant_turn(text or contract()),
        weight=0.5,
        Delta=0.0,
        duration=1.0,
        repeats=1,
        scene=f"g{number}",
        memory=f"m{number}",
        events=(number,),
        source="tiny",
        graspable=("red_cube", "tin"),
        receptive=(),
    )


ASKED = tuple(sample(number) for number in range(MIN_QUESTIONS))
ANSWERS = (
    (contract(), True, True),
    (contract(speed=0.2), True, True),
    (contract("tin"), True, False),
    (contract(speed=9.0), False, False),
    (contract("ghost"), False, False),
    ("grasp it", False, False),
    (contract(skill="decline"), False, False),
    (contract()[:-2], False, False),
)


@pytest.fixture
def known_answers(monkeypatch):
    """Known answers in place of a model's, and a known perplexity."""

    def answer(planner, turns, *, max_tokens):
        number = int(turns[0]["content"].split()[-1]) % len(ANSWERS)
        return RawCompletion(ANSWERS[number][0], True, (), ())

    monkeypatch.setattr("dualbrain.adaptation.serving.measurement.complete", answer)
    monkeypatch.setattr("dualbrain.adaptation.serving.measurement.perplexity", lambda planner, text: 12.5)


def test_each_answer_is_scored_by_the_gate_and_against_the_instruction(known_answers):
    found = measure_planner(None, ASKED, REGISTRY, adapter="a", runtime="r")
    assert [(t.compliant, t.right) for t in found.trials] == [
        ANSWERS[n % len(ANSWERS)][1:] for n in range(MIN_QUESTIONS)
    ]
    assert {t.success for t in found.trials} == {None}
    assert [t.scene for t in found.trials] == [one.scene for one in ASKED]
    assert (found.adapter, found.runtime, found.perplexity) == ("a", "r", 12.5)
    executed = []

    def execute(one, text):
        executed.append(text)
        return True, 0.01

    closed = measure_planner(None, ASKED, REGISTRY, adapter="a", runtime="r", execute=execute)
    assert [(t.success, t.Delta) for t in closed.trials] == [
        (True, 0.01) if t.compliant else (False, None) for t in found.trials
    ]
    assert len(executed) == sum(t.compliant for t in found.trials)  # contracts that the gate rejects are not executed


def test_too_few_questions_and_a_runtime_without_answers_are_errors(known_answers, monkeypatch):
    with pytest.raises(ConfigurationError, match="held-out questions"):
        select_questions(ASKED[1:])
    with pytest.raises(ConfigurationError, match="held-out questions"):
        select_questions(ASKED, 10)
    assert len(select_questions((*ASKED, *ASKED), 40)) == 40
    few = tuple(replace(one, scene=f"g{number % (MIN_SCENES - 1)}") for number, one in enumerate(ASKED))
    with pytest.raises(ConfigurationError, match="scenes of the held-out questions: got 9"):
        select_questions(few)
    monkeypatch.setattr(
        "dualbrain.adaptation.serving.measurement.complete",
        lambda *a, **k: ChatResponse(text="", finish_reason="timeout"),
    )
    with pytest.raises(Exception, match="timeout"):
        measure_planner(None, ASKED, REGISTRY, adapter="a", runtime="r")


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A home with the tiny base, a packaged adapter, and an adapter on top of it in the registry."""
    monkeypatch.setattr(packaged, "PACKAGED_FOLDER", tmp_path / "packaged")
    tiny_adapter.install_base(tmp_path / "cache", monkeypatch)
    (tmp_path / "packaged").mkdir()
    lower, card = tiny_adapter.write_adapter(model("llama"), tmp_path / "packaged" / "first")
    tiny_adapter.write_adapter(lower.merge_and_unload(), tmp_path / "fit", 6, base="first", base_sha256=card.id)
    registry = AdapterRegistry(tmp_path / "adapters")
    registry.add(tmp_path / "fit", now=0.0)
    for module in (adapters_command, export, adapters_measure):
        monkeypatch.setattr(module, "cache_folder", lambda: tmp_path / "cache")
    monkeypatch.setattr(adapters_command, "dualbrain_home", lambda: tmp_path)
    monkeypatch.setattr("dualbrain.grounding.vocabulary.load_skill_registry", lambda robot: REGISTRY)
    return tmp_path


def data_set(train, rows):
    """A data set for the robot of these tests."""
    held_out_hash = dataset_hash(encode_samples(train), encode_samples(rows))
    card = DatasetCard(
        hash=held_out_hash,
        form="",
        robot="panda",
        registry=REGISTRY.hash,
        prompt=short_template_hash(),
        ledger="",
        event=0,
        memories=0,
        train=len(train),
        held_out=len(rows),
        shown=0,
        scenes=0,
        merged=0,
        left_out={},
        sources={},
        epsilon=0.0,
        slowest=1.5,
        most_repeats=4,
        share_held_out=1.0,
        salt="",
    )
    return Dataset(card, train, rows)


@pytest.fixture
def short_answers(monkeypatch):
    """Answers of three tokens, and a short text for the perplexity."""
    monkeypatch.setattr("dualbrain.adaptation.serving.measurement.MAX_ANSWER_TOKENS", 3)
    monkeypatch.setattr("dualbrain.adaptation.serving.measurement.retention_text", lambda: "The sea is blue.")


def test_a_candidate_and_its_base_are_measured_and_written_for_the_gate(home, short_answers, capsys):
    data = data_set((), tuple(sample(number) for number in range(MIN_QUESTIONS)))
    write_dataset(data, home / "data")
    one = AdapterRegistry(home / "adapters").ids()[0]
    assert adapters_measure.measure(one[:12], data=home / "data", out=home / "m.json", fly=False) == 0
    found = msgspec.json.decode((home / "m.json").read_bytes(), type=Measurement)
    assert (found.candidate.adapter, found.champion.adapter, found.dataset) == (one, "", data.card.hash)
    assert found.candidate.runtime == adapters_command.serving_runtime(AdapterRegistry(home / "adapters"), one)
    assert len(found.candidate.trials) == MIN_QUESTIONS
    assert found.candidate.perplexity != found.champion.perplexity
    assert "without execution, so it cannot justify a promotion" in " ".join(capsys.readouterr().err.split())


def test_the_output_file_is_checked_before_the_first_question(home, monkeypatch):
    asked = []

    def measure(stack, who, *others):
        assert (home / "results").is_dir()
        asked.append(who)
        return trial_results(who, 20)

    monkeypatch.setattr(adapters_measure, "_measure_adapter", measure)
    write_dataset(data_set((), ASKED), home / "data")
    (home / "file").touch()
    (one,) = AdapterRegistry(home / "adapters").ids()
    for out in (home / "file" / "m.json", home / "data"):
        with pytest.raises(FileWriteError, match=r"unchanged. Fix this"):
            adapters_measure.measure(one, data=home / "data", out=out, fly=False)
    assert not asked
    out = home / "results" / "today" / "m.json"
    assert adapters_measure.measure(one, data=home / "data", out=out, fly=False) == 0
    assert msgspec.json.decode(out.read_bytes(), type=Measurement).candidate.adapter == asked[0] == one
    assert list(out.parent.iterdir()) == [out]
    lower = read_adapter_card(home / "packaged" / "first").id
    for name, who in (("first", lower), (str(home / "fit"), one), (f"adapter:{one}", one)):
        assert adapters_measure.measure(name, data=home / "data", out=out, fly=False) == 0
        assert asked[-2:] == [who, ""]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"registry": "0" * 16}, f"vocabulary {'0' * 16} of panda, but the present one is {REGISTRY.hash}"),
        ({"prompt": "0" * 16}, f"prompt template {'0' * 16}, but the present one is {short_template_hash()}"),
        ({"robot": "ur5e"}, "is for ur5e, but the adapter is for panda"),
    ],
)
def test_a_data_set_of_another_vocabulary_prompt_or_robot_is_refused(home, monkeypatch, change, words):
    monkeypatch.setattr(adapters_measure, "_measure_adapter", lambda *args: pytest.fail("asked"))
    data = data_set((), ASKED)
    write_dataset(replace(data, card=replace(data.card, **change)), home / "data")
    (one,) = AdapterRegistry(home / "adapters").ids()
    with pytest.raises(ConfigurationError, match=words):
        adapters_measure.measure(one, data=home / "data", out=home / "m.json", fly=False)


def test_both_are_executed_and_known_training_data_is_not_asked(home, short_answers, capsys, monkeypatch):
    monkeypatch.setenv("DUALBRAIN_HOME", str(home))
    (trained,) = distinct_episodes(1)
    data = data_set(
        (), (*(sample(number) for number in range(MIN_QUESTIONS)), replace(sample(MIN_QUESTIONS), memory=trained.id))
    )
    write_dataset(data, home / "data")
    one = AdapterRegistry(home / "adapters").ids()[0]
    with pytest.raises(MissingDependencyError, match=r"memory ledger.*--ledger.*--no-fly"):
        adapters_measure.measure(one, data=home / "data", out=home / "m.json")
    asked = []
    monkeypatch.setattr(
        "dualbrain.runtime.inspection.memory_replay.make_replay_evaluator",
        lambda ledger, rows, *, seed: asked.extend(rows) or (lambda row, text: (True, 0.001)),
    )
    write_ledger(home, [trained], lambda memory: record_adapter(memory, one, "d" * 64, [trained.id], now=NOW)).close()
    assert adapters_measure.measure(one, data=home / "data", out=home / "m.json") == 0
    found = msgspec.json.decode((home / "m.json").read_bytes(), type=Measurement)
    assert [row.id for row in asked] == [trial.question for trial in found.candidate.trials]
    assert None not in {trial.success for results in (found.candidate, found.champion) for trial in results.trials}
    assert len(asked) == MIN_QUESTIONS
    assert "left out: 1 questions" in capsys.readouterr().err


def test_perplexity_agrees_with_torch(home):
    folder = home / "packaged" / "first"
    planner = start_llama(
        load_stack(folder, home / "cache"),
        home / "cache",
        LlamaConfig(n_ctx=512),
        prompt_format=UNCONSTRAINED_SHORT_PROMPT,
    )
    try:
        found = perplexity(planner, "The sea is blue.")
    finally:
        planner.close()
    adapted = PeftModel.from_pretrained(model("llama"), folder).eval()
    tokens = tokenizer()("The sea is blue.", add_special_tokens=False)["input_ids"]
    with torch.no_grad():
        log_p = adapted(input_ids=torch.tensor([tokens])).logits[0].log_softmax(-1)
    rest = range(len("The"), len(tokens))  # one token per byte
    mean = sum(float(log_p[place - 1, tokens[place]]) for place in rest) / len(rest)
    assert found == pytest.approx(math.exp(-mean), rel=0.02)


@pytest.mark.parametrize("form", ["peft", "hub", "gguf", "merged"])
def test_an_exported_adapter_computes_the_same(home, form):
    one = AdapterRegistry(home / "adapters").ids()[0]
    upper = PeftModel.from_pretrained(
        PeftModel.from_pretrained(model("llama"), home / "packaged" / "first").merge_and_unload(), home / "fit"
    )
    expected = torch_log_probs(upper.eval())
    assert export.export(one[:12], home / "out", form=form) == 0
    (home / "plain").touch()
    for file in filter(Path.is_file, (home / "out", *home.glob("out/*"))):
        assert file.stat().st_mode == (home / "plain").stat().st_mode
    base = home / "cache" / "tiny.gguf"
    match form:
        case "peft" | "hub":
            config = json.loads((home / "out" / "adapter_config.json").read_text())
            assert (config["bias"], config["use_dora"], config["modules_to_save"], config["r"]) == (
                "none",
                False,
                None,
                8,
            )
            found, tolerance = torch_log_probs(PeftModel.from_pretrained(model("llama"), home / "out").eval()), 1e-4
        case "gguf":
            found, tolerance = llama_log_probs(base, home / "out"), 2e-4
        case "merged":
            found, tolerance = llama_log_probs(home / "out", None), 2e-2  # half precision
    np.testing.assert_allclose(found, expected, atol=tolerance)
    with pytest.raises(ConfigurationError, match="exists already"):
        export.export(one[:12], home / "out", form=form)


def test_layer_differences_agree_with_full_matrices(tmp_path):
    for seed in (5, 6):
        random_adapter(model("llama"), tmp_path / str(seed), seed=seed, r=seed - 2)
    first, second = (read_lora(tmp_path / str(seed)) for seed in (5, 6))
    found = compare_layers(first, second)
    for gap in found:
        whole = [pair.b @ pair.a for pair in (first[gap.layer], second[gap.layer])]
        assert gap.first == pytest.approx(np.linalg.norm(whole[0]), rel=1e-3)
        assert gap.apart == pytest.approx(np.linalg.norm(whole[0] - whole[1]), rel=1e-3)
    assert [gap.apart for gap in found] == sorted((gap.apart for gap in found), reverse=True)
    assert combine_layers(compare_layers(first, first)).apart == pytest.approx(0.0, abs=1e-3)


def test_diff_prints_cards_and_layers(home, capsys):
    one = AdapterRegistry(home / "adapters").ids()[0]
    assert export.diff(one[:12], "first") == 0
    output = capsys.readouterr().out
    assert "base: first | tiny" in output
    assert "‖difference‖" in output
    card = read_adapter_card(home / "fit")
    assert compare_cards(card, card) == {}


def test_an_adapter_below_only_one_of_the_two_counts_as_part_of_it(home, capsys):
    """(B₁A₁ + B₂A₂) − B₁A₁ = B₂A₂."""
    (one,) = AdapterRegistry(home / "adapters").ids()
    first, second = (read_lora(home / name) for name in ("packaged/first", "fit"))
    both = compare_layers(concatenate_adapters([home / "packaged" / "first", home / "fit"]), first)
    for names, fields in (((one, "first"), ("first", "second")), (("first", one), ("second", "first"))):
        assert export.diff(*names, json=True) == 0
        total = json.loads(capsys.readouterr().out)["all"]
        assert total["apart"] == pytest.approx(combine_layers(compare_layers(second, {})).first, rel=1e-4)
        assert [total[field] for field in fields] == pytest.approx(
            [combine_layers(both).first, combine_layers(both).second]
        )
    tiny_adapter.write_adapter(model("llama"), home / "again", 7, base="first", base_sha256=base_model_hash("first"))
    assert export.diff(one, str(home / "again"), json=True) == 0  # a common base is left out
    total = json.loads(capsys.readouterr().out)["all"]
    assert total["first"] == pytest.approx(combine_layers(compare_layers(second, {})).first, rel=1e-4)


def test_adapters_of_different_models_are_not_compared(home, monkeypatch, capsys):
    other = dataclasses.replace(weights.find_weight_file("tiny"), name="other", sha256="0" * 64)
    monkeypatch.setitem(weights.MANIFEST, "other", other)
    tiny_adapter.write_adapter(model("llama"), home / "apart", 7, base="other", base_sha256="0" * 64)
    (one,) = AdapterRegistry(home / "adapters").ids()
    with pytest.raises(ConfigurationError, match="tiny and other"):
        export.diff(one, str(home / "apart"))
    assert capsys.readouterr().out == ""


def test_concatenated_adapters_of_unequal_rank_are_their_sum(tmp_path):
    random_adapter(model("llama"), tmp_path / "a", r=2)
    random_adapter(model("llama"), tmp_path / "b", seed=6, r=3, target_modules=["q_proj", "down_proj"])
    pairs = concatenate_adapters([tmp_path / "a", tmp_path / "b"])
    write_peft_adapter(pairs, tmp_path / "both", base="x")
    again = read_lora(tmp_path / "both")
    for module, pair in pairs.items():
        alone = [read_lora(tmp_path / name).get(module) for name in ("a", "b")]
        total = sum(one.b @ one.a for one in alone if one is not None)
        np.testing.assert_allclose(again[module].b @ again[module].a, total, atol=1e-5)
        assert pair.a.shape[0] == (5 if alone[1] is not None else 2)
    assert len(PROMPT) == 8
