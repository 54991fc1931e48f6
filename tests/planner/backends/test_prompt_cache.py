"""A cached state is found only with the same model, adapters, scales, context size, template and prefix."""

import hashlib
import os
from pathlib import Path

import pytest

from dualbrain.core.storage.verification_stamp import write_stamp
from dualbrain.planner.backends.llama_process import LoadedAdapter, read_file_state
from dualbrain.planner.backends.prompt_cache import MAX_CACHED_STATES, PromptCache
from dualbrain.planner.prompt.prompt_format import FULL_PROMPT, LOCAL_FULL_PROMPT, SHORT_PROMPT
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


def saving_server(folder, state=b"state"):
    """Behaviour of a server that writes `state` for a request to save, as llama.cpp does."""

    def behave(call):
        action, body = call.server.requests[-1]
        if action.endswith("action=save"):
            (folder / body["filename"]).write_bytes(state)
        respond_with(b"{}")(call)

    return behave


def write_state(path, state=b"state"):
    """Write a state with its checksum to `path`."""
    path.write_bytes(state)
    path.with_suffix(".sha256").write_text(hashlib.sha256(state).hexdigest())
    return path


def cache(model, address="", *, n_ctx=2048, adapters=(A,), prompt_format=FULL_PROMPT):
    return PromptCache(
        model.parent,
        model,
        n_ctx,
        address,
        "key",
        prompt_format=prompt_format,
        loaded_file=read_file_state(model),
        adapters=adapters,
    )


def test_every_part_of_the_key_changes_the_file(model):
    first = cache(model).state_path(plan_request())
    assert (
        cache(model).state_path(plan_request("another instruction")) == first
    )  # the last turn is not part of the prefix
    others = [
        cache(model, adapters=()),
        cache(model, adapters=(B,)),
        cache(model, adapters=(A, B)),
        cache(model, adapters=(B, A)),
        cache(model, adapters=(LoadedAdapter(A.path, A.id, 0.5),)),
        cache(model, n_ctx=4096),
        cache(model, prompt_format=SHORT_PROMPT),
        cache(model, prompt_format=LOCAL_FULL_PROMPT),
    ]
    found = [one.state_path(plan_request()) for one in others]
    found.append(cache(model).state_path(plan_request(recall=RetrievedContext(exemplars=(exemplar(),)))))
    model.write_bytes(b"other weights")
    found.append(cache(model).state_path(plan_request()))
    assert len({first, *found}) == len(found) + 1


def mark_verified(path, digest):
    """Write the stamp of a file with the verified hash `digest`."""
    write_stamp(path, digest)


def test_a_verified_model_is_identified_by_its_hash_and_others_by_name_size_and_date(model):
    first = cache(model).state_path(plan_request())
    mark_verified(model, "a" * 64)
    named = cache(model).state_path(plan_request())
    assert named != first
    os.utime(model, (1, 1))  # may have changed since it was verified
    assert cache(model).state_path(plan_request()) not in {first, named}
    mark_verified(model, "a" * 64)
    assert cache(model).state_path(plan_request()) == named
    mark_verified(model, "b" * 64)
    assert cache(model).state_path(plan_request()) not in {first, named}
    model.with_name(f".{model.name}.verified").write_text("torn")
    os.utime(model, (2, 2))
    assert cache(model).state_path(plan_request()) not in {first, named}


def replace_file(path):
    """Put another file in the place of the one at `path`, with the same name, size and date."""
    dates = (path.stat().st_atime_ns, path.stat().st_mtime_ns)
    other = path.with_name("other.gguf")
    other.write_bytes(path.read_bytes()[::-1])
    os.utime(other, ns=dates)
    other.replace(path)


def verify_another(path):
    """Put another file in the place of the one at `path`, with a verified hash."""
    replace_file(path)
    mark_verified(path, "c" * 64)


@pytest.mark.parametrize("change", [Path.unlink, replace_file, verify_another])
def test_a_model_file_that_is_no_longer_the_loaded_one_has_no_state(model, change):
    """The server still has the weights of the former file."""
    with serve(saving_server(model.parent)) as server:
        one = cache(model, server.url.removesuffix("/v1"))
        assert one.save(plan_request())
        change(model)
        server.requests.clear()
        assert one.state_path(plan_request()) is None
        assert not one.restore(plan_request())
        assert not one.save(plan_request(robot="base"))
    assert server.requests == []


def test_a_state_with_the_same_rules_is_valid_for_other_exemplars(model):
    with_memories = plan_request(recall=RetrievedContext(exemplars=(exemplar(),)))
    with serve(saving_server(model.parent)) as server:
        one = cache(model, server.url.removesuffix("/v1"))
        assert not one.restore(with_memories)
        write_state(one.state_path(plan_request()))
        assert one.restore(with_memories)
        assert not one.save(with_memories), "exemplars differ between requests"
        assert not one.restore(plan_request(robot="base"))
        assert one.save(plan_request(robot="base"))
    assert server.requests[0][1]["filename"] == one.state_path(plan_request()).name


def test_a_server_with_the_rules_restores_only_the_state_of_the_same_examples(model):
    with_memories = plan_request(recall=RetrievedContext(exemplars=(exemplar(),)))
    all_of_a_kind = plan_request("put all the red things in the bowl")
    with serve(saving_server(model.parent)) as server:
        one = cache(model, server.url.removesuffix("/v1"))
        plain, every = one.state_path(plan_request()), one.state_path(all_of_a_kind)
        assert plain != every
        write_state(plain)
        assert not one.restore(all_of_a_kind, plain), "the server has read the rules"
        assert not one.restore(with_memories, plain)
        assert one.save(all_of_a_kind), "a selection of built-in examples has its own state"
        assert one.restore(all_of_a_kind, plain)
        assert one.restore(plan_request(), every)
        assert one.restore(with_memories, one.state_path(plan_request(robot="base"))), "rules of another robot"
    restored = [body["filename"] for action, body in server.requests if action.endswith("restore")]
    assert restored[:2] == [every.name, plain.name]


def test_a_restored_state_is_kept_longest(model):
    with serve(saving_server(model.parent)) as server:
        one = cache(model, server.url.removesuffix("/v1"))
        requests = [plan_request(robot=f"robot_{k}") for k in range(MAX_CACHED_STATES + 1)]
        for k, request in enumerate(requests[:-1]):
            assert one.save(request)
            os.utime(one.state_path(request), (k, k))
        assert one.restore(requests[0])
        assert one.save(requests[-1])
        assert one.state_path(requests[0]).is_file()
        assert not one.state_path(requests[1]).is_file()


def test_only_the_newest_states_of_a_model_are_kept(model):
    other = write_state(model.with_name("other-1.slot"), b"of another model")
    with serve(saving_server(model.parent)) as server:
        one = cache(model, server.url.removesuffix("/v1"))
        names = []
        for k in range(MAX_CACHED_STATES + 2):
            request = plan_request(robot=f"robot_{k}")
            assert one.save(request)
            os.utime(one.state_path(request), (k, k))
            names.append(one.state_path(request))
    for suffix in (".slot", ".sha256"):
        assert [path.with_suffix(suffix).is_file() for path in names] == [False] * 2 + [True] * MAX_CACHED_STATES
        assert other.with_suffix(suffix).is_file()


@pytest.mark.parametrize("name", ["model", "model[1]", "model-b"])
def test_states_of_models_with_similar_names_are_kept(tmp_path, name):
    model = tmp_path / f"{name}.gguf"
    model.write_bytes(b"weights")
    hashes = f"{'0' * 24}-{'1' * 24}"
    others = [write_state(tmp_path / f"{one}-{hashes}.slot") for one in ("model-instruct", f"{name}-q8", "model1")]
    for path in others:
        os.utime(path, (0, 0))
    with serve(saving_server(tmp_path)) as server:
        one = cache(model, server.url.removesuffix("/v1"))
        requests = [plan_request(robot=f"robot_{k}") for k in range(MAX_CACHED_STATES + 2)]
        for k, request in enumerate(requests):
            assert one.save(request)
            os.utime(one.state_path(request), (k, k))
        with_memories = plan_request(robot="robot_5", recall=RetrievedContext(exemplars=(exemplar(),)))
        assert one.restore(with_memories), "a state with the same rules"
    kept = [one.state_path(request).is_file() for request in requests]
    assert kept == [False] * 2 + [True] * MAX_CACHED_STATES
    assert all(path.is_file() for path in others)


def flip_bit(path):
    """Flip one bit of the state."""
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("damage", "removed"),
    [
        (flip_bit, True),
        (lambda path: path.write_bytes(path.read_bytes()[:-1]), True),
        (lambda path: path.with_suffix(".sha256").write_bytes(b"\xff"), True),
        (lambda path: path.with_suffix(".sha256").unlink(), False),
    ],
    ids=["a flipped bit", "truncated", "an unreadable checksum", "no checksum"],
)
def test_a_damaged_state_is_not_restored_and_is_saved_again(model, damage, removed):
    """llama.cpp would silently restore it and give other answers."""
    with serve(saving_server(model.parent)) as server:
        one = cache(model, server.url.removesuffix("/v1"))
        path = one.state_path(plan_request())
        assert one.save(plan_request())
        assert not one.save(plan_request()), "it is saved already"
        damage(path)
        server.requests.clear()
        assert not one.restore(plan_request())
        assert server.requests == []
        assert path.is_file() is not removed
        assert one.save(plan_request())
        assert one.restore(plan_request())


def test_another_state_with_the_same_rules_replaces_a_damaged_one(model):
    with_memories = plan_request(recall=RetrievedContext(exemplars=(exemplar(),)))
    with serve(saving_server(model.parent)) as server:
        one = cache(model, server.url.removesuffix("/v1"))
        flip_bit(write_state(one.state_path(with_memories)))
        write_state(one.state_path(plan_request()))
        assert one.restore(with_memories)
    assert [body["filename"] for _, body in server.requests] == [one.state_path(plan_request()).name]


def test_two_processes_may_prune_one_folder(model, monkeypatch):
    """A file that another process removes between two steps causes no error."""
    states = [write_state(model.with_name(f"model-{k}.slot")) for k in range(MAX_CACHED_STATES + 3)]
    for k, path in enumerate(states):
        os.utime(path, (k, k))
    stat, unlink = Path.stat, Path.unlink

    def stat_after_removal(path, **options):
        if path == states[-1]:
            unlink(path, missing_ok=True)
        return stat(path, **options)

    def unlink_twice(path, missing_ok=False):
        unlink(path, missing_ok=True)  # the other process
        unlink(path, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "stat", stat_after_removal)
    monkeypatch.setattr(Path, "unlink", unlink_twice)
    with serve(saving_server(model.parent)) as server:
        assert cache(model, server.url.removesuffix("/v1")).save(plan_request())
    monkeypatch.undo()
    assert len(list(model.parent.glob("model-*.slot"))) == MAX_CACHED_STATES


def test_a_state_without_a_file_or_a_checksum_is_not_kept(model):
    with serve(respond_with(b"{}")) as server:
        assert not cache(model, server.url.removesuffix("/v1")).save(plan_request())
    with serve(saving_server(model.parent)) as server:
        one = cache(model, server.url.removesuffix("/v1"))
        one.state_path(plan_request()).with_suffix(".sha256").mkdir()
        assert not one.save(plan_request())
        assert not one.state_path(plan_request()).exists()


def test_a_state_of_another_adapter_is_not_restored(model):
    with serve(respond_with(b"{}")) as server:
        address = server.url.removesuffix("/v1")
        write_state(cache(model, adapters=(A,)).state_path(plan_request()))
        assert not cache(model, address, adapters=(B,)).restore(plan_request())
        assert not cache(model, address, adapters=()).restore(plan_request())
        assert server.requests == []
        assert cache(model, address, adapters=(A,)).restore(plan_request())
    assert len(server.requests) == 1


def test_a_state_of_another_prompt_format_is_not_restored(model):
    with serve(saving_server(model.parent)) as server:
        full, local = (
            cache(model, server.url.removesuffix("/v1"), prompt_format=one) for one in (FULL_PROMPT, LOCAL_FULL_PROMPT)
        )
        assert full.save(plan_request())
        assert not local.restore(plan_request()), "id and context are in its rules and examples"
        assert local.save(plan_request())
        assert local.restore(plan_request())
        assert full.restore(plan_request(), local.state_path(plan_request()))
    restored = [body["filename"] for action, body in server.requests if action.endswith("restore")]
    assert restored == [one.state_path(plan_request()).name for one in (local, full)]
