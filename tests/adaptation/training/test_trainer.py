"""A fit ends as if it had never been interrupted, whatever interrupts it, and loses nothing when it cannot go on."""

import functools
import hashlib
import json
import os
import resource
import signal
from contextlib import suppress

import msgspec
import pytest

from dualbrain.adaptation.config import AdaptConfig, ObjectiveDials
from dualbrain.adaptation.curation.dataset import Dataset
from dualbrain.core.storage.atomic_files import DiskFull
from dualbrain.errors import InvalidSetup

torch = pytest.importorskip("torch", reason="the extra `adapt` is not installed")
pytest.importorskip("peft", reason="the extra `adapt` is not installed")

from peft import LoraConfig  # noqa: E402
from safetensors.torch import save  # noqa: E402

from dualbrain.adaptation.conversion.peft_lora import read_lora  # noqa: E402
from dualbrain.adaptation.training.checksummed_tensors import unpacked  # noqa: E402
from dualbrain.adaptation.training.model import lora_model as learner_room  # noqa: E402
from dualbrain.adaptation.training.model.batching import collate, prompt_ids  # noqa: E402
from dualbrain.adaptation.training.model.lora_model import worn  # noqa: E402
from dualbrain.adaptation.training.model.save_adapter import write_adapter  # noqa: E402
from dualbrain.adaptation.training.trainer import BEST, CHECKPOINT, STATES, Diverged  # noqa: E402
from tests.adaptation.tiny_model import DIALS, learner, model, moved, samples, tokenizer  # noqa: E402
from tests.adaptation.training.tiny_training import Bench, dataset, dials, exactly, sample  # noqa: E402


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """What an uninterrupted fit leaves."""
    bench = Bench(tmp_path_factory.mktemp("whole"))
    bench.run()
    return bench.left()


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(whole, tmp_path):
    again, other = Bench(tmp_path / "again"), Bench(tmp_path / "other", config=dials(seed=1))
    again.run()
    other.run()
    assert again.left() == whole
    assert other.left()[BEST] != whole[BEST]


@pytest.mark.parametrize("at", [1, 2, 3, 5])
def test_after_kill_9_it_ends_as_if_nothing_had_happened(whole, tmp_path, at):
    if (child := os.fork()) == 0:
        bench = Bench(tmp_path / "fit")
        bench.run(lambda progress: progress.step == at and os.kill(os.getpid(), signal.SIGKILL))
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status)
    assert os.WTERMSIG(status) == signal.SIGKILL
    bench = Bench(tmp_path / "fit")
    assert bench.fit.step == at - at % DIALS.save_every
    bench.run()
    assert bench.left() == whole


def test_a_finished_fit_takes_no_further_step(whole, tmp_path):
    Bench(tmp_path / "fit").run()
    told = []
    found = Bench(tmp_path / "fit").run(told.append)
    assert told == []
    assert found is not None


def test_a_loss_that_is_no_number_ends_it_and_nothing_of_it_is_kept(whole, tmp_path):
    bench = Bench(tmp_path / "fit")

    def poison(progress):
        if progress.step == 3:
            next(iter(bench.learner.parameters.values())).data.fill_(float("nan"))

    with pytest.raises(Diverged, match="step 4") as caught:
        bench.run(poison)
    assert caught.value.step == 4
    assert "another --out" in str(caught.value)
    again = Bench(tmp_path / "fit")
    assert again.fit.step == 2
    again.run()
    assert again.left() == whole


def test_a_full_disk_ends_it_and_the_last_checkpoint_stands(whole, tmp_path):
    bench = Bench(tmp_path / "fit")
    before, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    standing = {}

    def fill(progress):
        if progress.step == 3:
            standing.update(bench.left())
            resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))

    try:
        with pytest.raises(DiskFull, match="unchanged"):
            bench.run(fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (before, hard))
    assert standing
    assert bench.left() == standing
    again = Bench(tmp_path / "fit")
    assert again.fit.step == 2
    again.run()
    assert again.left() == whole


def test_a_checkpoint_of_another_run_or_a_damaged_one_is_refused(tmp_path):
    Bench(tmp_path / "fit").run()
    for change in (
        {"config": dials(rate=0.5)},
        {"config": AdaptConfig(fit=DIALS, objective=ObjectiveDials(beta=0.3))},
        {"data": dataset(name="b")},
    ):
        with pytest.raises(InvalidSetup, match="other data, dials or base"):
            Bench(tmp_path / "fit", **change)
    path = tmp_path / "fit" / CHECKPOINT
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InvalidSetup, match="damaged"):
        Bench(tmp_path / "fit")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"config": dials(rate=0.5)}, "fit rate 0.01, now 0.5"),
        ({"config": AdaptConfig(fit=DIALS, objective=ObjectiveDials(beta=0.3))}, "objective beta 0.05, now 0.3"),
        ({"data": dataset(name="b")}, "data set a, now b"),
    ],
)
def test_what_is_of_another_run_is_named_before_anything_is_written(whole, tmp_path, change, words):
    Bench(tmp_path / "fit").run()
    with pytest.raises(InvalidSetup, match=rf"{words}.*another --out"):
        Bench(tmp_path / "fit", **change)
    assert Bench(tmp_path / "fit").left() == whole


def flipped(path, where):
    """One bit of the byte at `where`, counted from the end, turned over."""
    data = bytearray(path.read_bytes())
    data[-where] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("where", [1, 500, 5000])
def test_no_flipped_bit_of_a_checkpoint_is_taken_for_a_number(tmp_path, where):
    Bench(tmp_path / "fit").run()
    flipped(tmp_path / "fit" / CHECKPOINT, where)
    with pytest.raises(InvalidSetup, match=r"damaged.*checkpoint\.safetensors"):
        Bench(tmp_path / "fit")


def test_a_flipped_bit_of_the_base_s_states_is_computed_anew(whole, tmp_path):
    Bench(tmp_path / "fit").run()
    flipped(tmp_path / "fit" / STATES, 40)
    assert Bench(tmp_path / "fit").left() == whole


@pytest.mark.parametrize("damage", [lambda path: flipped(path, 1), lambda path: path.write_bytes(b"{"), os.unlink])
@pytest.mark.parametrize("finished", [True, False])
def test_a_best_adapter_that_was_changed_is_not_worn(tmp_path, damage, finished):
    """Not even one that was changed while the fit stood still, and that nothing better came after."""
    config = dials(rate=1e-9, patience=9)

    def stop(progress):
        if progress.step == 4 and not finished:
            raise KeyboardInterrupt

    with suppress(KeyboardInterrupt):
        Bench(tmp_path / "fit", config=config).run(stop)
    damage(tmp_path / "fit" / BEST)
    with pytest.raises(InvalidSetup, match=r"damaged.*best\.safetensors"):
        Bench(tmp_path / "fit", config=config).run()


def test_a_best_adapter_newer_than_the_checkpoint_is_found_again(whole, tmp_path):
    """As after a kill between the two."""
    kept = {}

    def keep(progress):
        if progress.step == 4:
            kept["then"] = (tmp_path / "fit" / CHECKPOINT).read_bytes()

    Bench(tmp_path / "fit").run(keep)
    (tmp_path / "fit" / CHECKPOINT).write_bytes(kept["then"])
    bench = Bench(tmp_path / "fit")
    assert bench.fit.step == 4
    bench.run()
    assert bench.left() == whole


def test_a_checkpoint_from_before_there_were_checksums_is_taken_up(whole, tmp_path):
    def stop(progress):
        if progress.step == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Bench(tmp_path / "fit").run(stop)
    path = tmp_path / "fit" / CHECKPOINT
    tensors, facts = unpacked(path)
    mark = json.loads(facts["mark"])
    objective, fit = (msgspec.to_builtins(part) for part in (ObjectiveDials(), DIALS))
    key = hashlib.sha256(msgspec.json.encode(["a", "base", "torch.float32", objective, fit])).hexdigest()[:32]
    old = {"run": key, "step": mark["step"], "patience": mark["patience"]}
    path.write_bytes(save(tensors, {"mark": json.dumps(old)}))
    bench = Bench(tmp_path / "fit")
    assert bench.fit.step == 4
    bench.run()
    assert bench.left() == whole
    path.write_bytes(save(tensors, {"mark": json.dumps(old)}))
    with pytest.raises(InvalidSetup, match="other data, dials or base', allowed"):
        Bench(tmp_path / "fit", config=dials(rate=0.5))


def test_samples_at_once_are_a_matter_of_memory_only(tmp_path):
    four, one = Bench(tmp_path / "four"), Bench(tmp_path / "one", config=dials(at_once=1))
    four.run()
    one.run()
    for name, tensor in four.learner.adapter().items():
        torch.testing.assert_close(one.learner.adapter()[name], tensor, rtol=2e-2, atol=2e-4)


def test_it_stops_early_and_wears_the_best(tmp_path):
    bench = Bench(tmp_path / "fit", config=dials(rate=1e-9, steps=40, patience=2))
    found = bench.run()
    assert bench.fit.step == 6
    assert found is not None
    assert found.step == 2
    assert bench.fit.finished


def test_the_last_is_kept_where_that_is_asked_for(tmp_path):
    """All steps are taken, and what is worn is where they led, however much better an earlier one was."""
    bench, asked = Bench(tmp_path / "fit", config=dials(rate=1e-9, steps=40, patience=2, keep="last")), []
    found = bench.run(lambda progress: asked.append(progress.held_out) if progress.held_out else None)
    assert (bench.fit.step, found.step) == (40, 40)
    assert asked == [found]  # the others would choose nothing
    assert bench.fit.finished


def test_without_a_held_out_part_the_newest_is_kept(tmp_path):
    bench = Bench(tmp_path / "fit", data=dataset(held_out=0))
    assert bench.run() is None
    assert bench.fit.step == DIALS.steps
    assert (tmp_path / "fit" / BEST).is_file()


def test_progress_tells_the_time_left(tmp_path):
    ticks = iter(range(1000))
    told = []
    Bench(tmp_path / "fit", clock=lambda: 10.0 * next(ticks)).run(told.append)
    assert [progress.step for progress in told] == [1, 2, 3, 4, 5, 6]
    assert [progress.seconds_left for progress in told] == pytest.approx([50.0, 40.0, 30.0, 20.0, 10.0, 0.0])
    assert [progress.held_out is not None for progress in told] == [False, True] * 3


def test_four_contracts_are_learnt_by_heart(tmp_path):
    """Free greedy answers are right at the end and were wrong at the beginning."""
    rows = tuple(sample(i) for i in range(4))
    same = Dataset(dataset().card, rows, rows)
    config = dials(steps=120, rate=2e-2, rank=8, ask_at_most=4, save_every=40, patience=9)
    bench = Bench(tmp_path / "fit", data=same, config=config)
    prompts = [prompt_ids(bench.learner.tokenizer, row.prompt) for row in rows]
    assert not any(map(exactly, bench.learner.answer(prompts, 20), rows))
    found = bench.run()
    assert found is not None
    assert found.compliance == 1.0
    assert all(map(exactly, bench.learner.answer(prompts, 20), rows))


def test_a_fit_whose_adapter_could_not_be_served_does_not_begin(monkeypatch):
    """As with a peft that knows more than this reader, and has it on."""
    monkeypatch.setattr(learner_room, "LoraConfig", functools.partial(LoraConfig, use_dora=True))
    with pytest.raises(InvalidSetup, match="use_dora"):
        learner()


def test_an_adapter_is_what_peft_loads(tmp_path):
    """To the bit, once its numbers are rounded to those of the file."""
    one = moved(learner())
    write_adapter(one, tmp_path / "adapter", base="sha256 of the base")
    one.wear({name: tensor.to(torch.bfloat16).float() for name, tensor in one.adapter().items()})
    loaded = worn(model(), tmp_path / "adapter")
    assert len(read_lora(tmp_path / "adapter")) == len(one.adapter()) / 2
    batch = collate(samples(3), one.padding)
    mask = batch.ids != one.padding
    with torch.no_grad():
        ours, theirs = (m(input_ids=batch.ids, attention_mask=mask).logits for m in (one.model, loaded))
        base = model()(input_ids=batch.ids, attention_mask=mask).logits
    assert torch.equal(ours, theirs)
    assert not torch.allclose(ours, base)
    assert json.loads((tmp_path / "adapter" / "adapter_config.json").read_text())["r"] == DIALS.rank
    assert not list((tmp_path / "adapter").glob("*.bin"))


def test_nothing_that_is_too_long_is_cut(tmp_path):
    data = Dataset(dataset().card, (sample(0, words="x" * 3000),), ())
    with pytest.raises(InvalidSetup, match="tokens of sample s0"):
        Bench(tmp_path / "fit", data=data)
    with pytest.raises(InvalidSetup, match="training samples"):
        Bench(tmp_path / "none", data=Dataset(dataset().card, (), ()))


def test_a_base_whose_logits_are_made_otherwise_is_refused():
    one = learner()
    one.check(samples(1)[0])
    one.head = one.head * 0.5
    with pytest.raises(InvalidSetup, match="hidden"):
        one.check(samples(1)[0])


def test_the_tokens_are_those_of_the_chat_template():
    words = tokenizer()
    ids = prompt_ids(words, [{"role": "user", "content": "hello"}])
    assert words.decode(list(ids)) == "u:helloA:"
