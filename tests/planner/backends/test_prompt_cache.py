"""A kept state is found only by who left it: same model, adapters, scales, context size, template and beginning."""

import hashlib
import json
import os
from pathlib import Path

import pytest

from dualbrain.planner.backends.llama_process import Worn
from dualbrain.planner.backends.prompt_cache import KEPT, PrefixStore
from dualbrain.planner.prompt.prompt_format import FULL, SHORT
from dualbrain.records import Recall
from tests.planner.backends.fake_chat_server import says, serve
from tests.planner.sample_requests import exemplar, request

pytest.importorskip("xllamacpp")
A, B = Worn(Path("a.gguf"), "a" * 64), Worn(Path("b.gguf"), "b" * 64)


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.gguf"
    path.write_bytes(b"weights")
    return path


def keeps(folder, state=b"state"):
    """A server that writes `state` when it is told to save, as llama.cpp does."""

    def behave(call):
        action, told = call.server.asked[-1]
        if action.endswith("action=save"):
            (folder / told["filename"]).write_bytes(state)
        says(b"{}")(call)

    return behave


def left(path, state=b"state"):
    """A state at `path`, as it was once saved."""
    path.write_bytes(state)
    path.with_suffix(".sha256").write_text(hashlib.sha256(state).hexdigest())
    return path


def store(model, address="", *, n_ctx=2048, adapters=(A,), asking=FULL):
    return PrefixStore(model.parent, model, n_ctx, address, "key", asking=asking, adapters=adapters)


def test_every_part_of_it_names_another_file(model):
    first = store(model).path(request())
    assert store(model).path(request("another instruction")) == first  # the last turn is not part of the prefix
    others = [
        store(model, adapters=()), store(model, adapters=(B,)), store(model, adapters=(A, B)),
        store(model, adapters=(B, A)), store(model, adapters=(Worn(A.path, A.id, 0.5),)), store(model, n_ctx=4096),
        store(model, asking=SHORT),
    ]  # fmt: skip
    found = [one.path(request()) for one in others]
    found.append(store(model).path(request(recall=Recall(exemplars=(exemplar(),)))))
    model.write_bytes(b"other weights")
    found.append(store(model).path(request()))
    assert len({first, *found}) == len(found) + 1


def verified(path, digest):
    """As `weights.locate` leaves a file whose hash it has found to be `digest`."""
    state = path.stat()
    stamp = {"sha256": digest, "size": state.st_size, "mtime_ns": state.st_mtime_ns}
    path.with_name(f".{path.name}.verified").write_text(json.dumps(stamp))


def test_a_verified_model_is_known_by_its_hash_and_any_other_by_name_size_and_date(model):
    first = store(model).path(request())
    verified(model, "a" * 64)
    named = store(model).path(request())
    assert named != first
    os.utime(model, (1, 1))  # changed since it was verified, for all one knows
    assert store(model).path(request()) not in {first, named}
    verified(model, "a" * 64)
    assert store(model).path(request()) == named
    verified(model, "b" * 64)
    assert store(model).path(request()) not in {first, named}
    model.with_name(f".{model.name}.verified").write_text("torn")
    os.utime(model, (2, 2))
    assert store(model).path(request()) not in {first, named}


def test_a_state_of_the_same_rules_serves_under_other_exemplars_and_none_of_other_rules_does(model):
    recalled = request(recall=Recall(exemplars=(exemplar(),)))
    with serve(keeps(model.parent)) as server:
        one = store(model, server.url.removesuffix("/v1"))
        assert not one.restore(recalled)
        left(one.path(request()))
        assert one.restore(recalled)
        assert one.rules(recalled) == one.rules(request())
        assert not one.save(recalled), "exemplars change from question to question"
        assert one.rules(request(robot="base")) != one.rules(request())
        assert not one.restore(request(robot="base"))
        assert one.save(request(robot="base"))
    assert server.asked[0][1]["filename"] == one.path(request()).name


def test_only_the_newest_states_of_a_model_are_kept(model):
    other = left(model.with_name("other-1.slot"), b"of another model")
    with serve(keeps(model.parent)) as server:
        one = store(model, server.url.removesuffix("/v1"))
        names = []
        for k in range(KEPT + 2):
            asked = request(robot=f"robot_{k}")
            assert one.save(asked)
            os.utime(one.path(asked), (k, k))
            names.append(one.path(asked))
    for suffix in (".slot", ".sha256"):
        assert [path.with_suffix(suffix).is_file() for path in names] == [False] * 2 + [True] * KEPT
        assert other.with_suffix(suffix).is_file()


def flipped(path):
    """One bit of the state."""
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "removed"),
    [
        (flipped, True), (lambda path: path.write_bytes(path.read_bytes()[:-1]), True),
        (lambda path: path.with_suffix(".sha256").write_bytes(b"\xff"), True),
        (lambda path: path.with_suffix(".sha256").unlink(), False),
    ],
    ids=["a flipped bit", "torn", "a signature that cannot be read", "none, as of old"],
)  # fmt: skip
def test_a_state_that_is_not_as_it_was_saved_is_not_restored_and_saved_anew(model, damage, removed):
    """llama.cpp restores it without a word, and answers otherwise."""
    with serve(keeps(model.parent)) as server:
        one = store(model, server.url.removesuffix("/v1"))
        path = one.path(request())
        assert one.save(request())
        assert not one.save(request()), "it is kept already"
        damage(path)
        server.asked.clear()
        assert not one.restore(request())
        assert server.asked == []
        assert path.is_file() is not removed
        assert one.save(request())
        assert one.restore(request())


def test_beside_a_damaged_state_another_of_the_same_rules_serves(model):
    recalled = request(recall=Recall(exemplars=(exemplar(),)))
    with serve(keeps(model.parent)) as server:
        one = store(model, server.url.removesuffix("/v1"))
        flipped(left(one.path(recalled)))
        left(one.path(request()))
        assert one.restore(recalled)
    assert [told["filename"] for _, told in server.asked] == [one.path(request()).name]


def test_two_processes_may_prune_one_folder(model, monkeypatch):
    """What another one removes between any two steps of ours is only gone."""
    whole = [left(model.with_name(f"model-{k}.slot")) for k in range(KEPT + 3)]
    for k, path in enumerate(whole):
        os.utime(path, (k, k))
    look, unlink = Path.stat, Path.unlink

    def seen(path, **how):
        if path == whole[-1]:
            unlink(path, missing_ok=True)
        return look(path, **how)

    def gone(path, missing_ok=False):
        unlink(path)
        unlink(path, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "stat", seen)
    monkeypatch.setattr(Path, "unlink", gone)
    with serve(keeps(model.parent)) as server:
        assert store(model, server.url.removesuffix("/v1")).save(request())
    monkeypatch.undo()
    assert len(list(model.parent.glob("model-*.slot"))) == KEPT


def test_a_state_that_is_gone_or_cannot_be_signed_is_not_kept(model):
    with serve(says(b"{}")) as server:
        assert not store(model, server.url.removesuffix("/v1")).save(request())
    with serve(keeps(model.parent)) as server:
        one = store(model, server.url.removesuffix("/v1"))
        one.path(request()).with_suffix(".sha256").mkdir()
        assert not one.save(request())
        assert not one.path(request()).exists()


def test_a_state_of_another_adapter_is_not_restored(model):
    with serve(says(b"{}")) as server:
        address = server.url.removesuffix("/v1")
        left(store(model, adapters=(A,)).path(request()))
        assert not store(model, address, adapters=(B,)).restore(request())
        assert not store(model, address, adapters=()).restore(request())
        assert server.asked == []
        assert store(model, address, adapters=(A,)).restore(request())
    assert len(server.asked) == 1
