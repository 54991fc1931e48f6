"""A kept state is found only by who left it: same model, adapters, scales, context size, template and beginning."""

import hashlib
import json
import os
from pathlib import Path

import pytest

from dualbrain.planner.backends.llama_process import LoadedAdapter
from dualbrain.planner.backends.prompt_cache import MAX_CACHED_STATES, PromptCache
from dualbrain.planner.prompt.prompt_format import FULL_PROMPT, SHORT_PROMPT
from dualbrain.records import RetrievedContext
from tests.planner.backends.fake_chat_server import respond_with, serve
from tests.planner.sample_requests import exemplar, plan_request

pytest.importorskip("xllamacpp")
A, B = LoadedAdapter(Path("a.gguf"), "a" * 64), LoadedAdapter(Path("b.gguf"), "b" * 64)


@pytest.fixture
def model(tmp_path):
    path = tmp_path / "model.gguf"
    path.write_bytes(b"weights")
    return path


def keeps(folder, state=b"state"):
    """A server that writes `state` when it is told to save, as llama.cpp does."""

    def behave(call):
        action, body = call.server.requests[-1]
        if action.endswith("action=save"):
            (folder / body["filename"]).write_bytes(state)
        respond_with(b"{}")(call)

    return behave


def left(path, state=b"state"):
    """A state at `path`, as it was once saved."""
    path.write_bytes(state)
    path.with_suffix(".sha256").write_text(hashlib.sha256(state).hexdigest())
    return path


def store(model, address="", *, n_ctx=2048, adapters=(A,), prompt_format=FULL_PROMPT):
    return PromptCache(model.parent, model, n_ctx, address, "key", prompt_format=prompt_format, adapters=adapters)


def test_every_part_of_it_names_another_file(model):
    first = store(model).state_path(plan_request())
    assert (
        store(model).state_path(plan_request("another instruction")) == first
    )  # the last turn is not part of the prefix
    others = [
        store(model, adapters=()),
        store(model, adapters=(B,)),
        store(model, adapters=(A, B)),
        store(model, adapters=(B, A)),
        store(model, adapters=(LoadedAdapter(A.path, A.id, 0.5),)),
        store(model, n_ctx=4096),
        store(model, prompt_format=SHORT_PROMPT),
    ]
    found = [one.state_path(plan_request()) for one in others]
    found.append(store(model).state_path(plan_request(recall=RetrievedContext(exemplars=(exemplar(),)))))
    model.write_bytes(b"other weights")
    found.append(store(model).state_path(plan_request()))
    assert len({first, *found}) == len(found) + 1


def verified(path, digest):
    """As `weights.locate` leaves a file whose hash it has found to be `digest`."""
    state = path.stat()
    stamp = {"sha256": digest, "size": state.st_size, "mtime_ns": state.st_mtime_ns}
    path.with_name(f".{path.name}.verified").write_text(json.dumps(stamp))


def test_a_verified_model_is_known_by_its_hash_and_any_other_by_name_size_and_date(model):
    first = store(model).state_path(plan_request())
    verified(model, "a" * 64)
    named = store(model).state_path(plan_request())
    assert named != first
    os.utime(model, (1, 1))  # changed since it was verified, for all one knows
    assert store(model).state_path(plan_request()) not in {first, named}
    verified(model, "a" * 64)
    assert store(model).state_path(plan_request()) == named
    verified(model, "b" * 64)
    assert store(model).state_path(plan_request()) not in {first, named}
    model.with_name(f".{model.name}.verified").write_text("torn")
    os.utime(model, (2, 2))
    assert store(model).state_path(plan_request()) not in {first, named}


def test_a_state_of_the_same_rules_serves_under_other_exemplars_and_none_of_other_rules_does(model):
    recalled = plan_request(recall=RetrievedContext(exemplars=(exemplar(),)))
    with serve(keeps(model.parent)) as server:
        one = store(model, server.url.removesuffix("/v1"))
        assert not one.restore(recalled)
        left(one.state_path(plan_request()))
        assert one.restore(recalled)
        assert one.rules_key(recalled) == one.rules_key(plan_request())
        assert not one.save(recalled), "exemplars change from question to question"
        assert one.rules_key(plan_request(robot="base")) != one.rules_key(plan_request())
        assert not one.restore(plan_request(robot="base"))
        assert one.save(plan_request(robot="base"))
    assert server.requests[0][1]["filename"] == one.state_path(plan_request()).name


def test_only_the_newest_states_of_a_model_are_kept(model):
    other = left(model.with_name("other-1.slot"), b"of another model")
    with serve(keeps(model.parent)) as server:
        one = store(model, server.url.removesuffix("/v1"))
        names = []
        for k in range(MAX_CACHED_STATES + 2):
            asked = plan_request(robot=f"robot_{k}")
            assert one.save(asked)
            os.utime(one.state_path(asked), (k, k))
            names.append(one.state_path(asked))
    for suffix in (".slot", ".sha256"):
        assert [path.with_suffix(suffix).is_file() for path in names] == [False] * 2 + [True] * MAX_CACHED_STATES
        assert other.with_suffix(suffix).is_file()


def flipped(path):
    """One bit of the state."""
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "removed"),
    [
        (flipped, True),
        (lambda path: path.write_bytes(path.read_bytes()[:-1]), True),
        (lambda path: path.with_suffix(".sha256").write_bytes(b"\xff"), True),
        (lambda path: path.with_suffix(".sha256").unlink(), False),
    ],
    ids=["a flipped bit", "torn", "a signature that cannot be read", "none, as of old"],
)
def test_a_state_that_is_not_as_it_was_saved_is_not_restored_and_saved_anew(model, damage, removed):
    """llama.cpp restores it without a word, and answers otherwise."""
    with serve(keeps(model.parent)) as server:
        one = store(model, server.url.removesuffix("/v1"))
        path = one.state_path(plan_request())
        assert one.save(plan_request())
        assert not one.save(plan_request()), "it is kept already"
        damage(path)
        server.requests.clear()
        assert not one.restore(plan_request())
        assert server.requests == []
        assert path.is_file() is not removed
        assert one.save(plan_request())
        assert one.restore(plan_request())


def test_beside_a_damaged_state_another_of_the_same_rules_serves(model):
    recalled = plan_request(recall=RetrievedContext(exemplars=(exemplar(),)))
    with serve(keeps(model.parent)) as server:
        one = store(model, server.url.removesuffix("/v1"))
        flipped(left(one.state_path(recalled)))
        left(one.state_path(plan_request()))
        assert one.restore(recalled)
    assert [told["filename"] for _, told in server.requests] == [one.state_path(plan_request()).name]


def test_two_processes_may_prune_one_folder(model, monkeypatch):
    """What another one removes between any two steps of ours is only gone."""
    whole = [left(model.with_name(f"model-{k}.slot")) for k in range(MAX_CACHED_STATES + 3)]
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
        assert store(model, server.url.removesuffix("/v1")).save(plan_request())
    monkeypatch.undo()
    assert len(list(model.parent.glob("model-*.slot"))) == MAX_CACHED_STATES


def test_a_state_that_is_gone_or_cannot_be_signed_is_not_kept(model):
    with serve(respond_with(b"{}")) as server:
        assert not store(model, server.url.removesuffix("/v1")).save(plan_request())
    with serve(keeps(model.parent)) as server:
        one = store(model, server.url.removesuffix("/v1"))
        one.state_path(plan_request()).with_suffix(".sha256").mkdir()
        assert not one.save(plan_request())
        assert not one.state_path(plan_request()).exists()


def test_a_state_of_another_adapter_is_not_restored(model):
    with serve(respond_with(b"{}")) as server:
        address = server.url.removesuffix("/v1")
        left(store(model, adapters=(A,)).state_path(plan_request()))
        assert not store(model, address, adapters=(B,)).restore(plan_request())
        assert not store(model, address, adapters=()).restore(plan_request())
        assert server.requests == []
        assert store(model, address, adapters=(A,)).restore(plan_request())
    assert len(server.requests) == 1
