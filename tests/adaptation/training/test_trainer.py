"""A run gives the same result after any interruption, and loses nothing when it cannot continue."""

import functools
import hashlib
import json
import os
import resource
import signal
from contextlib import suppress

import msgspec
import pytest

from dualbrain.adaptation.config import AdaptConfig, ObjectiveConfig
from dualbrain.adaptation.curation.dataset import Dataset
from dualbrain.core.storage.atomic_files import FileWriteError
from dualbrain.errors import ConfigurationError

torch = pytest.importorskip("torch", reason="the extra `adapt` is not installed")
pytest.importorskip("peft", reason="the extra `adapt` is not installed")

from peft import LoraConfig  # noqa: E402
from safetensors.torch import save  # noqa: E402

from dualbrain.adaptation.conversion.peft_lora import read_lora  # noqa: E402
from dualbrain.adaptation.training.checksummed_tensors import read_tensors  # noqa: E402
from dualbrain.adaptation.training.model import lora_model as lora_model_module  # noqa: E402
from dualbrain.adaptation.training.model.batching import collate, tokenize_prompt  # noqa: E402
from dualbrain.adaptation.training.model.lora_model import load_peft_adapter  # noqa: E402
from dualbrain.adaptation.training.model.save_adapter import save_adapter  # noqa: E402
from dualbrain.adaptation.training.trainer import BEST_FILE, CHECKPOINT_FILE, STATES_FILE, TrainingDivergedError  # noqa: E402
from tests.adaptation.tiny_model import TRAINING_CONFIG, lora_model, model, perturbed, random_samples, tokenizer  # noqa: E402
from tests.adaptation.training.tiny_training import TinyTraining, config_with, dataset, exact_match, sample  # noqa: E402


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """The files of an uninterrupted run."""
    bench = TinyTraining(tmp_path_factory.mktemp("whole"))
    bench.run()
    return bench.output_files()


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(uninterrupted, tmp_path):
    again, other = TinyTraining(tmp_path / "again"), TinyTraining(tmp_path / "other", config=config_with(seed=1))
    again.run()
    other.run()
    assert again.output_files() == uninterrupted
    assert other.output_files()[BEST_FILE] != uninterrupted[BEST_FILE]


@pytest.mark.parametrize("at", [1, 2, 3, 5])
def test_after_a_kill_the_run_gives_the_same_files(uninterrupted, tmp_path, at):
    if (child := os.fork()) == 0:
        bench = TinyTraining(tmp_path / "fit")
        bench.run(lambda progress: progress.step == at and os.kill(os.getpid(), signal.SIGKILL))
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status)
    assert os.WTERMSIG(status) == signal.SIGKILL
    bench = TinyTraining(tmp_path / "fit")
    assert bench.trainer.step == at - at % TRAINING_CONFIG.save_every
    bench.run()
    assert bench.output_files() == uninterrupted


def test_a_finished_run_takes_no_further_step(uninterrupted, tmp_path):
    TinyTraining(tmp_path / "fit").run()
    reports = []
    found = TinyTraining(tmp_path / "fit").run(reports.append)
    assert reports == []
    assert found is not None


def test_a_loss_that_is_not_finite_ends_the_run_and_its_step_is_discarded(uninterrupted, tmp_path):
    bench = TinyTraining(tmp_path / "fit")

    def poison(progress):
        if progress.step == 3:
            next(iter(bench.lora_model.parameters.values())).data.fill_(float("nan"))

    with pytest.raises(TrainingDivergedError, match="step 4") as caught:
        bench.run(poison)
    assert caught.value.step == 4
    assert "another --out" in str(caught.value)
    again = TinyTraining(tmp_path / "fit")
    assert again.trainer.step == 2
    again.run()
    assert again.output_files() == uninterrupted


def test_a_full_disk_ends_the_run_and_keeps_the_last_checkpoint(uninterrupted, tmp_path):
    bench = TinyTraining(tmp_path / "fit")
    before, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    files_before = {}

    def fill(progress):
        if progress.step == 3:
            files_before.update(bench.output_files())
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))

    try:
        with pytest.raises(FileWriteError, match="unchanged"):
            bench.run(fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (before, hard))
    assert files_before
    assert bench.output_files() == files_before
    again = TinyTraining(tmp_path / "fit")
    assert again.trainer.step == 2
    again.run()
    assert again.output_files() == uninterrupted


def test_a_checkpoint_of_another_run_or_a_damaged_one_is_rejected(tmp_path):
    TinyTraining(tmp_path / "fit").run()
    for change in (
        {"config": config_with(rate=0.5)},
        {"config": AdaptConfig(fit=TRAINING_CONFIG, objective=ObjectiveConfig(beta=0.3))},
        {"data": dataset(name="b")},
    ):
        with pytest.raises(ConfigurationError, match="other data, settings or base"):
            TinyTraining(tmp_path / "fit", **change)
    path = tmp_path / "fit" / CHECKPOINT_FILE
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ConfigurationError, match="damaged"):
        TinyTraining(tmp_path / "fit")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"config": config_with(rate=0.5)}, "fit rate 0.01, now 0.5"),
        (
            {"config": AdaptConfig(fit=TRAINING_CONFIG, objective=ObjectiveConfig(beta=0.3))},
            "objective beta 0.05, now 0.3",
        ),
        ({"data": dataset(name="b")}, "data set a, now b"),
    ],
)
def test_differences_from_another_run_are_named_before_anything_is_written(uninterrupted, tmp_path, change, words):
    TinyTraining(tmp_path / "fit").run()
    with pytest.raises(ConfigurationError, match=rf"{words}.*another --out"):
        TinyTraining(tmp_path / "fit", **change)
    assert TinyTraining(tmp_path / "fit").output_files() == uninterrupted


def flip_bit(path, where):
    """Flip one bit of the byte at `where`, counted from the end."""
    data = bytearray(path.read_bytes())
    data[-where] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("where", [1, 500, 5000])
def test_a_flipped_bit_of_a_checkpoint_is_detected(tmp_path, where):
    TinyTraining(tmp_path / "fit").run()
    flip_bit(tmp_path / "fit" / CHECKPOINT_FILE, where)
    with pytest.raises(ConfigurationError, match=r"damaged.*checkpoint\.safetensors"):
        TinyTraining(tmp_path / "fit")


def test_reference_states_with_a_flipped_bit_are_computed_again(uninterrupted, tmp_path):
    TinyTraining(tmp_path / "fit").run()
    flip_bit(tmp_path / "fit" / STATES_FILE, 40)
    assert TinyTraining(tmp_path / "fit").output_files() == uninterrupted


@pytest.mark.parametrize("damage", [lambda path: flip_bit(path, 1), lambda path: path.write_bytes(b"{"), os.unlink])
@pytest.mark.parametrize("finished", [True, False])
def test_a_changed_best_adapter_is_rejected(tmp_path, damage, finished):
    """Also if it was changed while the run was interrupted and no better adapter followed."""
    config = config_with(rate=1e-9, patience=9)

    def stop(progress):
        if progress.step == 4 and not finished:
            raise KeyboardInterrupt

    with suppress(KeyboardInterrupt):
        TinyTraining(tmp_path / "fit", config=config).run(stop)
    damage(tmp_path / "fit" / BEST_FILE)
    with pytest.raises(ConfigurationError, match=r"damaged.*best\.safetensors"):
        TinyTraining(tmp_path / "fit", config=config).run()


def test_a_best_adapter_newer_than_the_checkpoint_is_reproduced(uninterrupted, tmp_path):
    """As after a kill between writing the two files."""
    kept = {}

    def keep(progress):
        if progress.step == 4:
            kept["then"] = (tmp_path / "fit" / CHECKPOINT_FILE).read_bytes()

    TinyTraining(tmp_path / "fit").run(keep)
    (tmp_path / "fit" / CHECKPOINT_FILE).write_bytes(kept["then"])
    bench = TinyTraining(tmp_path / "fit")
    assert bench.trainer.step == 4
    bench.run()
    assert bench.output_files() == uninterrupted


def test_a_checkpoint_of_an_older_version_without_checksum_is_resumed(uninterrupted, tmp_path):
    def stop(progress):
        if progress.step == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        TinyTraining(tmp_path / "fit").run(stop)
    path = tmp_path / "fit" / CHECKPOINT_FILE
    tensors, facts = read_tensors(path)
    mark = json.loads(facts["mark"])
    objective, fit = (msgspec.to_builtins(part) for part in (ObjectiveConfig(), TRAINING_CONFIG))
    key = hashlib.sha256(msgspec.json.encode(["a", "base", "torch.float32", objective, fit])).hexdigest()[:32]
    old = {"run": key, "step": mark["step"], "patience": mark["patience"]}
    path.write_bytes(save(tensors, {"mark": json.dumps(old)}))
    bench = TinyTraining(tmp_path / "fit")
    assert bench.trainer.step == 4
    bench.run()
    assert bench.output_files() == uninterrupted
    path.write_bytes(save(tensors, {"mark": json.dumps(old)}))
    with pytest.raises(ConfigurationError, match=r"other data, settings or base\. "):
        TinyTraining(tmp_path / "fit", config=config_with(rate=0.5))


def test_the_number_of_samples_per_forward_pass_only_affects_memory(tmp_path):
    four, one = TinyTraining(tmp_path / "four"), TinyTraining(tmp_path / "one", config=config_with(at_once=1))
    four.run()
    one.run()
    for name, tensor in four.lora_model.adapter_tensors().items():
        torch.testing.assert_close(one.lora_model.adapter_tensors()[name], tensor, rtol=2e-2, atol=2e-4)


def test_training_stops_early_and_keeps_the_best_adapter(tmp_path):
    bench = TinyTraining(tmp_path / "fit", config=config_with(rate=1e-9, steps=40, patience=2))
    found = bench.run()
    assert bench.trainer.step == 6
    assert found is not None
    assert found.step == 2
    assert bench.trainer.is_finished


def test_the_last_adapter_is_kept_on_request(tmp_path):
    """All steps are taken, and the last adapter is kept even if an earlier one was better."""
    config, evaluations = config_with(rate=1e-9, steps=40, patience=2, keep="last"), []
    bench = TinyTraining(tmp_path / "fit", config=config)
    found = bench.run(lambda progress: evaluations.append(progress.held_out) if progress.held_out else None)
    assert (bench.trainer.step, found.step) == (40, 40)
    assert evaluations == [found]  # earlier evaluations would have no effect
    assert bench.trainer.is_finished


def test_without_a_held_out_part_the_last_adapter_is_kept(tmp_path):
    bench = TinyTraining(tmp_path / "fit", data=dataset(held_out=0))
    assert bench.run() is None
    assert bench.trainer.step == TRAINING_CONFIG.steps
    assert (tmp_path / "fit" / BEST_FILE).is_file()


def test_progress_reports_the_remaining_time(tmp_path):
    ticks = iter(range(1000))
    reports = []
    TinyTraining(tmp_path / "fit", clock=lambda: 10.0 * next(ticks)).run(reports.append)
    assert [progress.step for progress in reports] == [1, 2, 3, 4, 5, 6]
    assert [progress.seconds_left for progress in reports] == pytest.approx([50.0, 40.0, 30.0, 20.0, 10.0, 0.0])
    assert [progress.held_out is not None for progress in reports] == [False, True] * 3


def test_four_contracts_are_memorised(tmp_path):
    """Greedy answers are wrong at the beginning and right at the end."""
    rows = tuple(sample(i) for i in range(4))
    same = Dataset(dataset().card, rows, rows)
    config = config_with(steps=120, rate=2e-2, rank=8, ask_at_most=4, save_every=40, patience=9)
    bench = TinyTraining(tmp_path / "fit", data=same, config=config)
    prompts = [tokenize_prompt(bench.lora_model.tokenizer, row.prompt) for row in rows]
    assert not any(map(exact_match, bench.lora_model.generate_answers(prompts, 20), rows))
    found = bench.run()
    assert found is not None
    assert found.compliance == 1.0
    assert all(map(exact_match, bench.lora_model.generate_answers(prompts, 20), rows))


def test_training_of_an_adapter_that_cannot_be_served_does_not_start(monkeypatch):
    """As with a version of peft that has another method on by default."""
    monkeypatch.setattr(lora_model_module, "LoraConfig", functools.partial(LoraConfig, use_dora=True))
    with pytest.raises(ConfigurationError, match="use_dora"):
        lora_model()


def test_a_saved_adapter_equals_the_one_that_peft_loads(tmp_path):
    """Equal to the bit after rounding to the number format of the file."""
    one = perturbed(lora_model())
    save_adapter(one, tmp_path / "adapter", base="sha256 of the base")
    one.load_adapter({name: tensor.to(torch.bfloat16).float() for name, tensor in one.adapter_tensors().items()})
    loaded = load_peft_adapter(model(), tmp_path / "adapter")
    assert len(read_lora(tmp_path / "adapter")) == len(one.adapter_tensors()) / 2
    batch = collate(random_samples(3), one.padding_id)
    mask = batch.ids != one.padding_id
    with torch.no_grad():
        ours, theirs = (m(input_ids=batch.ids, attention_mask=mask).logits for m in (one.model, loaded))
        base = model()(input_ids=batch.ids, attention_mask=mask).logits
    assert torch.equal(ours, theirs)
    assert not torch.allclose(ours, base)
    assert json.loads((tmp_path / "adapter" / "adapter_config.json").read_text())["r"] == TRAINING_CONFIG.rank
    assert not list((tmp_path / "adapter").glob("*.bin"))


def test_a_sample_that_is_too_long_is_rejected(tmp_path):
    data = Dataset(dataset().card, (sample(0, contract="x" * 3000),), ())
    with pytest.raises(ConfigurationError, match=r"tokens of sample s0.*quarantine"):
        TinyTraining(tmp_path / "fit", data=data)
    synthetic = msgspec.structs.replace(data.train[0], memory="")
    with pytest.raises(ConfigurationError, match=r"tokens of sample s0.*shorter prompts"):
        TinyTraining(tmp_path / "synthetic", data=Dataset(dataset().card, (synthetic,), ()))
    with pytest.raises(ConfigurationError, match="training samples"):
        TinyTraining(tmp_path / "none", data=Dataset(dataset().card, (), ()))


def test_a_base_with_other_logits_is_rejected():
    one = lora_model()
    one.check_logits(random_samples(1)[0])
    one.head = one.head * 0.5
    with pytest.raises(ConfigurationError, match="hidden"):
        one.check_logits(random_samples(1)[0])


def test_prompt_tokens_follow_the_chat_template():
    tiny_tokenizer = tokenizer()
    ids = tokenize_prompt(tiny_tokenizer, [{"role": "user", "content": "hello"}])
    assert tiny_tokenizer.decode(list(ids)) == "u:helloA:"
